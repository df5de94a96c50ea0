"""`dscp train`: learn from optimal trajectories."""

from __future__ import annotations

import argparse

from dscp_ros.cli import ExitCode
from dscp_ros.cli.arguments import overrides, print_json
from dscp_ros.cli.options import add_computing, add_folder, add_json, add_values
from dscp_ros.cli.output_files import check_folder

DESCRIPTION = "Trains a part of the planner."

EPILOG = """\
examples:
  dscp train terminal-time --output out/training
  dscp train terminal-time --output out/training --resume
"""

TERMINAL_TIME_DESCRIPTION = """\
Trains the network that predicts the optimal terminal time of a powered descent from position and
velocity, in the paper's box of initial states.

The default recipe solves some thousand states with the terminal time as a decision, fits the
network to them, and refines it by the gradients of fixed-time plans at its own predictions. The
recipe `paper` is stochastic gradient descent on such gradients from the start, with the paper's
numbers: hours, for comparison.

Writes terminal_time.safetensors (the network), history.json and training.png into a directory,
and a checkpoint meanwhile: --resume goes on from it, also after a crash, to the same result.
"""

TERMINAL_TIME_EPILOG = """\
examples:
  dscp train terminal-time --output out/training
  dscp train terminal-time --output out/quick --labels 1024 --rounds 1
  dscp train terminal-time --output out/heavy --set thrust_max=900e3
  dscp train terminal-time --recipe paper --output out/paper --epochs 20
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the command."""
    parser = subparsers.add_parser(
        "train", help="learn from optimal trajectories", description=DESCRIPTION, epilog=EPILOG
    )
    parts = parser.add_subparsers(title="what to train", metavar="WHAT", required=True)
    _add_terminal_time(parts)


def _add_terminal_time(parts: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = parts.add_parser(
        "terminal-time",
        help="the network that predicts the terminal time",
        description=TERMINAL_TIME_DESCRIPTION,
        epilog=TERMINAL_TIME_EPILOG,
    )
    add_folder(parser, "out/training")
    parser.add_argument(
        "--resume", action="store_true", help="go on from the checkpoint in the directory"
    )
    parser.add_argument(
        "--recipe",
        default="default",
        metavar="NAME",
        help="how to train: default, or paper (default %(default)s)",
    )
    parser.add_argument("--labels", type=int, metavar="N", help="states solved for their optimum")
    parser.add_argument("--steps", type=int, metavar="N", help="steps of the fit")
    parser.add_argument("--rounds", type=int, metavar="N", help="rounds of the refinement")
    parser.add_argument("--epochs", type=int, metavar="N", help="epochs of the recipe paper")
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of everything random (default 0)"
    )
    add_computing(parser)
    add_json(parser)
    group = parser.add_argument_group("vehicle")
    add_values(group)
    group.add_argument(
        "--intervals",
        type=int,
        default=50,
        metavar="N",
        help="time intervals of the trajectories (default %(default)s)",
    )
    parser.set_defaults(run=run_terminal_time)


def run_terminal_time(args: argparse.Namespace) -> int:
    """Trains, writes the files, prints where they are and how good the network is.

    Returns:
        The exit code.

    Raises:
        InvalidInputError: A value that cannot be used.
    """
    check_folder(args.output)
    from dscp_core import problems
    from dscp_core.learning.figures import training_figure, write_figure
    from dscp_core.learning.recipes import adjusted, recipe
    from dscp_core.learning.training import TrainingSettings, train

    chosen = adjusted(
        recipe(args.recipe),
        labels=args.labels,
        steps=args.steps,
        rounds=args.rounds,
        epochs=args.epochs,
    )
    result = train(
        TrainingSettings(
            problem=problems.get(problems.DEFAULT),
            recipe=chosen,
            output=args.output,
            parameters=overrides(args),
            intervals=args.intervals,
            seed=args.seed,
            workers=args.workers,
            ray_address=args.ray,
            resume=args.resume,
            show_progress=not args.json,
        )
    )
    picture = args.output / "training.png"
    write_figure(
        training_figure(result.history, f"Terminal-time network, recipe {chosen.name}"), picture
    )
    summary = {
        "network": str(result.network),
        "figure": str(picture),
        "elapsed_s": result.elapsed_s,
        "validation_mean_relative_error": result.errors.mean,
        "validation_p99_relative_error": result.errors.p99,
        "validation_max_relative_error": result.errors.maximum,
    }
    if args.json:
        print_json(summary)
    else:
        print(
            f"relative error on {chosen.validation} states that were not trained on: "
            f"mean {result.errors.mean:.1e}, 99th percentile {result.errors.p99:.1e}, "
            f"greatest {result.errors.maximum:.1e}; {result.elapsed_s / 60.0:.1f} min"
        )
        print(f"wrote {result.network}")
        print(f"wrote {picture}")
    return ExitCode.OK
