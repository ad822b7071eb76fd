"""Counts and times of tests, from the JUnit files that pytest writes. Standard library only."""

from __future__ import annotations

import json
import xml.etree.ElementTree as xml
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Report:
    """Counts and times of tests, read from the files that pytest wrote.

    Attributes
    ----------
    passed, failed, skipped : int
        Tests.
    durations : list of dict
        ``suite``, ``test``, ``seconds`` (set-up and tear-down included) of each, the slowest first.
    """

    passed: int = 0
    failed: int = 0
    skipped: int = 0
    durations: list[dict] = field(default_factory=list)

    def add(self, path: Path) -> int:
        """Count the tests of a report; how many there were."""
        if not path.exists():
            return 0
        root, total = xml.parse(path).getroot(), 0
        for suite in root.iter("testsuite"):
            tests, skipped = int(suite.get("tests", 0)), int(suite.get("skipped", 0))
            failed = int(suite.get("failures", 0)) + int(suite.get("errors", 0))
            self.failed += failed
            self.skipped += skipped
            self.passed += tests - failed - skipped
            total += tests
        for case in root.iter("testcase"):
            test = f"{case.get('classname')}::{case.get('name')}"
            self.durations.append({"suite": path.stem, "test": test, "seconds": float(case.get("time", 0))})
        return total

    def write(self, path: Path) -> None:
        """Keep the times."""
        self.durations.sort(key=lambda entry: -entry["seconds"])
        path.write_text(json.dumps(self.durations, indent=0), encoding="utf-8")

    def slowest(self, count: int) -> list[str]:
        """Lines that name the slowest tests."""
        entries = sorted(self.durations, key=lambda entry: -entry["seconds"])[:count]
        return [f"{entry['seconds']:7.1f} s  {entry['suite']:<8} {entry['test']}" for entry in entries]
