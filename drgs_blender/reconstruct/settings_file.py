"""Settings of a reconstruction in files: TOML that people write, and the metadata of assets that it made."""

from __future__ import annotations

import json
import textwrap
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.asset.container import inspect_asset
from ..core.errors import AssetError, UsageError
from .settings import Reading, Settings
from .settings_table import NONE, STAGES, as_tables, table

#: Bytes of a file of settings, at most.
LARGEST = 1 << 20
_WIDTH = 110
_REMEDY = "`drgs reconstruct --print-settings` prints a file of settings"


def read_settings(path: Path) -> dict[str, Any]:
    """Values by name, from a TOML file or from an asset that `drgs reconstruct` made.

    Raises
    ------
    UsageError
        The file is absent, too large, no TOML in UTF-8, or an asset without settings.
    AssetError
        An asset is damaged.
    """
    if path.suffix.lower() == ".drgs":
        return _of_asset(path)
    try:
        if not path.is_file():
            problem = "is a folder" if path.is_dir() else "is not there" if not path.exists() else "is no regular file"
            raise UsageError(str(path), problem, "Choose a TOML file of settings, or an asset")
        if (size := path.stat().st_size) > LARGEST:
            raise UsageError(str(path), f"has {size} bytes, more than {LARGEST}", _REMEDY)
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise UsageError(str(path), f"cannot be read ({error.strerror or error})", "Check the path") from error
    except UnicodeDecodeError as error:
        raise UsageError(str(path), "is not UTF-8 text", "Save it as UTF-8") from error
    try:
        return flat(tomllib.loads(text.replace("\r\n", "\n")))
    except (ValueError, RecursionError) as error:
        raise UsageError(str(path), f"is not TOML: {error}", _REMEDY) from error


def _of_asset(path: Path) -> dict[str, Any]:
    try:
        settings = inspect_asset(path, verify=False)["provenance"].get("settings")
    except AssetError as error:
        raise AssetError(error.subject, error.problem, "Choose another asset, or a TOML file") from error
    if not isinstance(settings, dict):
        problem = "holds no settings: it was not reconstructed, or by an earlier version"
        raise UsageError(str(path), problem, "Give a TOML file of settings")
    try:
        return flat(settings)
    except RecursionError as error:
        raise AssetError(str(path), "holds settings inside of too many tables", "Choose another asset") from error


def flat(tables: Mapping[str, Any]) -> dict[str, Any]:
    """Values by name, "stage.field", from those in tables; deeper ones keep the names of all tables."""
    found: dict[str, Any] = {}
    for name, value in tables.items():
        inner = {f"{name}.{key}": item for key, item in flat(value).items()} if isinstance(value, dict) else None
        found |= {name: value} if inner is None else inner
    return found


def parse_setting(text: str) -> tuple[str, Any]:
    """(name, value) of "schedule.iterations=500"; the value as TOML writes it, texts without quotes too.

    Raises
    ------
    UsageError
        There is no "=".

    Examples
    --------
    >>> parse_setting("schedule.densify=[0.1, 0.5]"), parse_setting("variant=m")
    (('schedule.densify', [0.1, 0.5]), ('variant', 'm'))
    """
    name, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not name:
        raise UsageError(f"--set {text}", "is not NAME=VALUE", "As in --set schedule.iterations=5000")
    try:
        parsed = tomllib.loads(f"value = {value}")
    except (ValueError, RecursionError):
        parsed = {}
    return name, parsed["value"] if parsed.keys() == {"value"} else value


def as_toml(settings: Settings, reading: Reading) -> str:
    """All settings as TOML that `read_settings` reads, each with what it means and may be."""
    values = flat(as_tables(settings, reading))
    lines: list[str] = []
    for stage, about in STAGES.items():
        lines += ["", f"# {about}.", *([f"[{stage}]"] if stage else [])]
        for row in (row for row in table().values() if row.stage == stage):
            lines += [f"# {line}" for line in textwrap.wrap(row.about, _WIDTH)]
            lines.append(f"{row.field} = {_toml(values[row.name])}  # {row.allowed}")
    return "\n".join(lines[1:]) + "\n"


def _toml(value: Any) -> str:
    """A value as TOML writes it; JSON writes all of these alike but None."""
    return json.dumps(NONE if value is None else value, ensure_ascii=False)
