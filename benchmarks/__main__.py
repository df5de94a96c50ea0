"""Command line: ``python -m benchmarks [NAME ...] [--quick] [--output DIR]``."""

from __future__ import annotations

import argparse
import gc
import importlib
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path

BENCHMARKS = {
    "start": "CPU time of imports, commands and the first plan in a fresh interpreter",
    "sweep": "gradients against central differences, iterations and optimum of the paper's case",
    "random_states": "how many random states of the paper's box get a certified plan, and how fast",
    "phases": "where the time of a forward run goes, and what a backward run costs beside it",
    "entry": "entry: overhead, backward against forward, growth with the number of intervals",
    "certificates": "random landings near their bounds against an independent flight; their cost",
    "latency": "state in to trajectory out: planner, and node over ROS topics with its memory",
    "best_effort": "best efforts of random infeasible landings against IPOPT, and their time",
    "training": "terminal-time network: error against wall time, the paper's recipe and ours",
    "prediction": "terminal-time network: time of one prediction, difference to PyTorch",
    "terminal_time_source": "free against predicted terminal times, by iteration limit",
    "cost_to_gain": "what plans are said to cost above a local optimum, against what they do",
    "sensitivity": "derivatives of one cone program against its solve, and against diffcp",
    "tuning": "how a tuning's gradients scale with the number of states and with the workers",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run benchmarks and print what they measured; the exit code says nothing about targets."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure and print the figures of this software beside their targets.",
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks to run (default: all)")
    parser.add_argument("--list", action="store_true", help="list the benchmarks and stop")
    parser.add_argument("--quick", action="store_true", help="fewer samples: some minutes in all")
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="also write each report to DIR/NAME.json"
    )
    args = parser.parse_args(argv)
    if args.list:
        for name, summary in BENCHMARKS.items():
            print(f"{name:20s} {summary}")
        return 0
    unknown = [name for name in args.names if name not in BENCHMARKS]
    if unknown:
        parser.error(f"unknown benchmark {', '.join(unknown)}; known: {', '.join(BENCHMARKS)}")
    if args.output is not None:
        args.output.mkdir(parents=True, exist_ok=True)
    print(f"Python {platform.python_version()} on {_processor()}; wall times by perf_counter")
    for name in args.names or BENCHMARKS:
        print(f"\n{name}: {BENCHMARKS[name]} ...", flush=True)
        measure = importlib.import_module(f"benchmarks.{name}").measure
        # The collector would otherwise walk all that is imported, again and again.
        gc.collect()
        gc.freeze()
        wall, cpu = time.perf_counter(), time.process_time()
        report = measure(quick=args.quick)
        report.seconds = time.perf_counter() - wall
        report.core_share = (time.process_time() - cpu) / report.seconds
        print(report.text(), flush=True)
        if args.output is not None:
            print(f"   written to {report.write(args.output)}")
    return 0


def _processor() -> str:
    """Name of the processor where Linux tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


if __name__ == "__main__":
    sys.exit(main())
