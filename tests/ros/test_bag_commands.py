"""`dscp bag`: exit codes, text and JSON."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
from std_msgs.msg import Float64

from dscp_ros.bag import BagReader, BagWriter
from dscp_ros.cli.main import main

COUNT = 300


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / "good.mcap"
    with BagWriter(path, chunk_bytes=1000, compression="none") as writer:
        writer.add_topic("/x", Float64)
        for index in range(COUNT):
            writer.write("/x", Float64(data=float(index)), 10**18 + index)
    return path


@pytest.fixture
def damaged(bag: Path, tmp_path: Path) -> Path:
    path = tmp_path / "damaged.mcap"
    content = bytearray(bag.read_bytes())
    content[content.index(struct.pack("<d", COUNT / 2))] ^= 0xFF  # the payload of one message
    path.write_bytes(content)
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main(["bag", *map(str, arguments)])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_info(capsys: pytest.CaptureFixture[str], bag: Path) -> None:
    code, text, _ = run(capsys, "info", bag)
    assert code == 0
    assert f"Messages:  {COUNT}" in text
    code, text, _ = run(capsys, "info", bag, "--json")
    assert code == 0
    assert json.loads(text)["topics"][0]["type"] == "std_msgs/msg/Float64"


def test_check_tells_good_from_damaged(
    capsys: pytest.CaptureFixture[str], bag: Path, damaged: Path
) -> None:
    code, text, _ = run(capsys, "check", bag)
    assert (code, text) == (0, f"{bag}: {COUNT} readable messages\nno damage found\n")
    code, text, _ = run(capsys, "check", damaged)
    assert code == 2
    assert "corrupt chunk" in text
    code, text, _ = run(capsys, "check", damaged, "--json")
    report = json.loads(text)
    assert code == 2
    assert report["messages_lost"] == COUNT - report["messages_read"] > 0


def test_recover(capsys: pytest.CaptureFixture[str], damaged: Path, tmp_path: Path) -> None:
    output = tmp_path / "recovered"
    code, text, _ = run(capsys, "recover", damaged, output, "--json")
    assert code == 0
    report = json.loads(text)
    assert report["output"] == str(output)
    with BagReader(output) as reader:
        assert reader.verify().messages_read == report["messages_read"] < COUNT
    code, _, error = run(capsys, "recover", damaged, output)
    assert code == 2
    assert "exists and is not overwritten" in error
    assert run(capsys, "recover", damaged, output, "--overwrite")[0] == 0
    assert run(capsys, "check", output)[0] == 0


@pytest.mark.parametrize("action", ["info", "check", "recover"])
@pytest.mark.parametrize("content", [None, b"", b"no bag at all"])
def test_bad_input_is_exit_code_2(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, action: str, content: bytes | None
) -> None:
    path = tmp_path / "b.mcap"
    if content is not None:
        path.write_bytes(content)
    arguments = [path, tmp_path / "output"] if action == "recover" else [path]
    code, _, error = run(capsys, action, *arguments)
    assert code == 2
    assert str(path) in error
    assert not (tmp_path / "output").exists()


def test_record_refuses_a_path_that_is_taken(capsys: pytest.CaptureFixture[str], bag: Path) -> None:
    before = bag.read_bytes()
    code, _, error = run(capsys, "record", bag, "/x")
    assert code == 2
    assert "exists" in error
    assert bag.read_bytes() == before
