"""Run benchmark programs one after the other; each writes its section of docs/benchmarks.md.

python bench/run.py [NAME ...]      # parity primary frame engine deform embree; all by default
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent


def main(names: list[str]) -> int:
    programs = {p.stem.removeprefix("bench_"): p for p in sorted(HERE.glob("bench_*.py"))}
    unknown = set(names) - set(programs)
    if unknown:
        print(f"no such benchmark: {', '.join(sorted(unknown))}; there are {', '.join(programs)}", file=sys.stderr)
        return 64
    failed = [name for name in names or programs if subprocess.run([sys.executable, str(programs[name])]).returncode]
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
