"""Run benchmark programs one after the other; each writes its section of docs/benchmarks.md.

python bench/run.py [NAME ...]      # parity primary frame light engine deform ...; all by default
python bench/run.py light --part equal-psnr --size 128      # what follows the names goes to the programs
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

BENCH = Path(__file__).resolve().parent


def run(program: Path, options: list[str]) -> int:
    publish = ["--publish"] * ("add_publish(" in program.read_text(encoding="utf-8"))  # pictures of the sections
    return subprocess.run([sys.executable, str(program), *publish, *options]).returncode


def main() -> int:
    programs = {p.stem.removeprefix("bench_"): p for p in sorted(BENCH.glob("bench_*.py"))}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(programs)}; all by default")
    chosen, options = parser.parse_known_args()
    unknown = set(chosen.names) - set(programs)
    if unknown:
        parser.error(f"no such benchmark: {', '.join(sorted(unknown))}; there are {', '.join(programs)}")
    failed = [name for name in chosen.names or programs if run(programs[name], options)]
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
