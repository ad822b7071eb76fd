"""Write docs/reconstruct-settings.md: the tables of all settings of a reconstruction, from their dataclasses."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from drgs_blender.reconstruct.settings_table import NONE, STAGES, table

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reconstruct-settings.md"
HEAD = """# All settings of a reconstruction

The tables are written by `tools/settings_page.py` from the dataclasses of the settings; the descriptions are theirs.

    drgs reconstruct --print-settings --variant m
    drgs reconstruct lego --out lego.drgs --config settings.toml
    drgs reconstruct lego --out lego.drgs --set schedule.iterations=8000 --set decoupling.normals=false
    drgs reconstruct lego --out again.drgs --config lego.drgs

- **`--config FILE.toml`** has the settings in tables named as the stages, those of the run before any table; what it
  leaves out stays as it is by default. `--print-settings` prints all of them as such a file (`... > settings.toml`),
  with what each is and may be, as other options, `--config` and `--set` that are given with it have changed them.
- **`--set NAME=VALUE`** changes one, with the name as below; lists and texts as in TOML, texts without quotes, too.
  Options and `--set` come before the file.
- **The asset keeps them all**: `drgs inspect --all` shows them, and `--config A.drgs` uses them again. The
  same photographs then give the same asset, bit for bit, unless time decides (`minutes`, `decoupling.seconds`).
- Unknown names are refused with the nearest one there is, values with what they may be (exit code 64). What is set and
  has no effect because of another setting is told.
- **In Blender** the dialog *Reconstruct from Photographs* has the most used ones, and *Settings*, a text of the Text
  Editor with such a file; *New Settings* there writes one with all of them.
"""


def page() -> str:
    """The whole page."""
    lines = [HEAD]
    for stage, about in STAGES.items():
        lines += [f"## {about}\n", "| Setting | Default | May be | Meaning |", "|---|---|---|---|"]
        for row in (row for row in table().values() if row.stage == stage):
            value = json.dumps(NONE if row.default is None else row.default)
            lines.append(f"| `{row.name}` | `{value}` | {row.allowed} | {row.about} |")
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    sys.stdout.write(f"{PAGE}\n")
