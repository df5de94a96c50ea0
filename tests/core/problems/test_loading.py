"""Problems by name, by entry point, and by file: what is found, and what is refused."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dscp_core import InvalidInputError, Planner, ProblemFamily, problems
from dscp_core.problems import loading

SOURCE = '''
"""A cart."""
from core.toy_problems import cart

CART = cart()
LIMIT = 3.0


def make_cart():
    return CART


def broken():
    raise KeyError("mass")


def needs(mass):
    return CART


def nothing():
    return None
'''

# For the toy problems, in a process of its own.
ROOTS = (str(Path(__file__).parents[3]), str(Path(__file__).parents[2]))


@pytest.fixture(autouse=True)
def _clean() -> Iterator[None]:
    """Leaves no trace of the files that were run."""
    path, modules = list(sys.path), dict(sys.modules)
    yield
    sys.path[:] = path
    for name in set(sys.modules) - set(modules):
        del sys.modules[name]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "my_problem.py"
    path.write_text(SOURCE, encoding="utf-8")
    return path


def refused(text: str) -> InvalidInputError:
    with pytest.raises(InvalidInputError) as caught:
        problems.get(text)
    assert caught.value.field == "problem"
    assert text in str(caught.value.value)
    return caught.value


def test_known_names() -> None:
    assert problems.names()[:2] == ("powered_descent", "entry")
    for name in problems.names():
        assert problems.get(name).name == name
        for form in problems.formulations(name):
            assert problems.get(name, form).formulation == form
    with pytest.raises(InvalidInputError, match="formulation"):
        problems.get("entry", "exact")


@pytest.mark.parametrize("name", ["CART", "make_cart"])
def test_a_variable_or_a_function_of_a_file(file: Path, name: str) -> None:
    assert problems.get(f"{file}:{name}").name == "cart"
    assert problems.formulations(f"{file}:{name}") == ()
    with pytest.raises(InvalidInputError, match="one form only"):
        problems.get(f"{file}:{name}", "printed")


def test_a_path_may_hold_colons_and_spaces(tmp_path: Path) -> None:
    folder = tmp_path / "a: b.py:c"
    folder.mkdir()
    path = folder / "my problem.v2.py"
    path.write_text(SOURCE, encoding="utf-8")
    assert problems.get(f"{path}:CART").name == "cart"


def test_relative_paths_and_links(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link.py").symlink_to(file)
    first = problems.get("my_problem.py:CART")
    assert problems.get("link.py:CART") is first, "one file runs once"


def test_a_family_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "family.py"
    path.write_text(
        "from dataclasses import replace\n"
        "from core.toy_problems import cart\n"
        "from dscp_core import ProblemFamily\n"
        "FAMILY = ProblemFamily(('light', 'heavy'), lambda f: replace(cart(), formulation=f))\n"
        "BAD = ProblemFamily(('one',), lambda f: 1 / 0)\n",
        encoding="utf-8",
    )
    assert problems.formulations(f"{path}:FAMILY") == ("light", "heavy")
    assert problems.get(f"{path}:FAMILY").formulation == "light"
    assert problems.get(f"{path}:FAMILY", "heavy").formulation == "heavy"
    assert "ZeroDivisionError" in refused(f"{path}:BAD").bound


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("LIMIT", "a function that returns one, or a ProblemFamily"),
        ("cart2", "the file has CART"),
        ("broken", "my_problem.py line 14: KeyError: 'mass'"),
        ("needs", "missing 1 required positional argument"),
        ("nothing", "a function that returns an OptimalControlProblem"),
    ],
)
def test_what_is_no_problem_is_refused_by_name(file: Path, name: str, said: str) -> None:
    with pytest.raises(InvalidInputError, match="problem") as caught:
        problems.get(f"{file}:{name}")
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("def f(:\n", "line 1: "),
        ("x = 1\n  y = 2\n", "line 2: "),
        ("import no_such_module_at_all\n", "line 1: ModuleNotFoundError"),
        ("\n\n1 / 0\n", "line 3: ZeroDivisionError"),
        ("import sys\nsys.exit(0)\n", "line 2: SystemExit: 0"),
        ("from . import helper\n", "line 1: ImportError"),
        ("def f():\n    f()\nf()\n", "RecursionError"),
        ("\x00", "null bytes"),
        ("# coding: no-such\n", "unknown encoding"),
        ("from core.toy_problems import CARTS\n", "ImportError: cannot import name 'CARTS'"),
    ],
)
def test_a_file_that_cannot_be_run_is_refused_with_its_line(
    tmp_path: Path, source: str, said: str
) -> None:
    path = tmp_path / "bad.py"
    path.write_text(source, encoding="utf-8")
    text = f"{path}:X"
    assert said in refused(text).bound
    assert said in refused(text).bound, "and again: nothing of it is left"


def test_a_png_is_no_python(tmp_path: Path) -> None:
    path = tmp_path / "picture.py"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    refused(f"{path}:X")


def test_a_file_is_looked_for(tmp_path: Path) -> None:
    assert "No such file" in refused(f"{tmp_path}/none.py:X").bound
    (tmp_path / "folder.py").mkdir()
    assert "not a directory" in refused(f"{tmp_path}/folder.py:X").bound
    os.mkfifo(tmp_path / "pipe.py")
    assert "not a device or pipe" in refused(f"{tmp_path}/pipe.py:X").bound
    large = tmp_path / "large.py"
    with large.open("wb") as stream:
        stream.truncate(20_000_000)
    assert "bytes" in refused(f"{large}:X").bound
    assert "null" in refused("nul\0l.py:X").bound


@pytest.mark.parametrize(
    "text", ["", "ascent", "a.py", "a.py:", ":X", "a.txt:X", "Entry", "../entry"]
)
def test_what_is_no_name_and_no_file(text: str) -> None:
    refused(text)


@pytest.mark.parametrize("name", ["", "1st", "a.b", "a b", "a()", "__import__('os')"])
def test_the_name_is_that_of_a_variable(file: Path, name: str) -> None:
    assert "Python variable" in refused(f"{file}:{name}").bound


@given(st.text(max_size=40))
def test_any_text_is_found_or_refused(text: str) -> None:
    if text in problems.names():
        return
    with pytest.raises(InvalidInputError):
        problems.get(text)


@given(st.text(max_size=20), st.text(max_size=20))
def test_any_file_name_is_found_or_refused(path: str, name: str) -> None:
    with pytest.raises(InvalidInputError):
        problems.get(f"no-such-folder/{path}.py:{name}")


def test_an_edited_file_is_run_again(file: Path) -> None:
    first = problems.get(f"{file}:CART")
    assert problems.get(f"{file}:CART") is first
    file.write_text(
        SOURCE + "from dataclasses import replace\nCART = replace(CART, name='second')\n",
        encoding="utf-8",
    )
    assert problems.get(f"{file}:CART").name == "second"
    assert first.name == "cart"


def test_a_module_beside_the_file_can_be_imported(tmp_path: Path) -> None:
    (tmp_path / "my_own_helpers.py").write_text(
        "from core.toy_problems import cart\n\n\ndef drag(p):\n    return p['drag']\n",
        encoding="utf-8",
    )
    # A neighbour does not take the place of what is installed.
    (tmp_path / "casadi.py").write_text("raise RuntimeError('not me')\n", encoding="utf-8")
    path = tmp_path / "with_helper.py"
    path.write_text(
        "from dataclasses import replace\n"
        "import casadi as ca\n"
        "from my_own_helpers import cart, drag\n"
        "CART = replace(cart(), dynamics=lambda x, u, p: "
        "ca.vertcat(x[1], (u[0] - drag(p) * x[1] ** 2) / p['mass']))\n",
        encoding="utf-8",
    )
    problem = problems.get(f"{path}:CART")
    assert Planner(problem).plan().converged
    pickled = tmp_path / "problem.pickle"
    pickled.write_bytes(pickle.dumps(problem))
    # A worker that has neither the file nor its neighbour.
    code = (
        f"import pickle\nproblem = pickle.load(open({str(pickled)!r}, 'rb'))\n"
        "from dscp_core import Planner\nassert Planner(problem).plan().converged"
    )
    for gone in (path, tmp_path / "my_own_helpers.py"):
        gone.unlink()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(ROOTS)}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path.parent, env=environment)


def test_modules_that_import_each_other_are_refused_as_such(tmp_path: Path) -> None:
    (tmp_path / "circle_a.py").write_text("from circle_b import y\nx = 1\n", encoding="utf-8")
    (tmp_path / "circle_b.py").write_text("from circle_a import x\ny = 1\n", encoding="utf-8")
    assert "circular import" in refused(f"{tmp_path}/circle_a.py:x").bound


def test_the_file_is_not_compiled_with_the_loaders_own_settings(tmp_path: Path) -> None:
    path = tmp_path / "plain.py"
    path.write_text(
        "from core.toy_problems import cart\n"
        "def f(x: int): ...\n"
        "assert f.__annotations__ == {'x': int}\n"
        "assert __name__ != '__main__' and __file__.endswith('plain.py')\n"
        "CART = cart()\n",
        encoding="utf-8",
    )
    assert problems.get(f"{path}:CART").name == "cart"


def install(folder: Path, distribution: str, entry: str, target: str) -> None:
    """Makes what an installed package leaves behind that offers a problem."""
    info = folder / f"{distribution}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n", encoding="utf-8"
    )
    (info / "entry_points.txt").write_text(
        f"[{loading.ENTRY_POINT_GROUP}]\n{entry} = {target}\n", encoding="utf-8"
    )


def test_an_entry_point(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site = file.parent
    install(site, "carts", "my_cart", "my_problem:CART")
    install(site, "makers", "my_maker", "my_problem:make_cart")
    install(site, "gone", "my_gone", "no_such_package.problem:X")
    install(site, "bad", "my_bad", "my_problem:LIMIT")
    install(site, "thief", "entry", "my_problem:CART")
    monkeypatch.syspath_prepend(str(site))
    assert {"my_cart", "my_maker", "my_gone", "my_bad"} <= set(problems.names())
    assert problems.names().count("entry") == 1
    assert problems.get("my_cart").name == problems.get("my_maker").name == "cart"
    assert problems.get("entry").name == "entry", "a shipped name cannot be taken"
    assert "no_such_package" in refused("my_gone").bound
    assert "ProblemFamily" in refused("my_bad").bound
    install(site, "twin", "my_cart", "my_problem:make_cart")
    assert "offered once" in refused("my_cart").bound


def test_a_family_is_what_it_is() -> None:
    family = loading.family_of("x", ProblemFamily((), lambda _: problems.get("entry")))
    assert family.make("").name == "entry"
    with pytest.raises(InvalidInputError, match="module"):
        loading.family_of("x", ModuleType("x"))
