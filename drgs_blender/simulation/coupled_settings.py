"""Settings of bodies that push each other, as JSON: those of each body, and how they touch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from ..core.errors import UsageError
from .contact import CONTACTS
from .coupled import Touch
from .settings import KEYS, Reader, Settings, parse_settings

#: Keys of a body that are no settings of a simulation alone.
_OWN = ("name", "asset", "out", "contact", "friction")
#: Settings in which bodies of one bake cannot differ.
_SAME = ("first", "last", "fps", "device", "courant")


@dataclass(frozen=True, slots=True)
class BodySettings:
    """A body of several.

    Attributes
    ----------
    name : str
        In messages.
    asset, out : Path
        Its .drgs file, and the folder of its cache.
    settings : Settings
    touch : Touch
        How it touches others.
    """

    name: str
    asset: Path
    out: Path
    settings: Settings
    touch: Touch


@dataclass(frozen=True, slots=True)
class CoupledSettings:
    """Bodies, and how pairs of them touch, by their numbers, the lower one first."""

    bodies: tuple[BodySettings, ...]
    touches: dict[tuple[int, int], Touch]


def parse_coupled(
    data: Any, subject: str = "settings", folder: Path | None = None, out: Path | None = None
) -> CoupledSettings:
    """Settings of a JSON object with "bodies", see docs/simulation.md.

    Parameters
    ----------
    data : object
    subject : str
        In messages.
    folder : Path, optional
        Where files that it names are.
    out : Path, optional
        Where the caches of bodies lie that name no folder.

    Raises
    ------
    UsageError
        Naming the body, what is wrong and what to do.
    """
    folder = folder or Path()
    reader = Reader(data, subject, folder)
    reader.keys(dict.fromkeys(("bodies", "contacts", "contact", "friction", *KEYS)))
    shared = {key: value for key, value in reader.data.items() if key not in ("bodies", "contacts")}
    bodies = tuple(_body(item, shared, out) for item in reader.items("bodies"))
    if not bodies:
        raise UsageError(f"{subject}, bodies", "is empty", 'Name bodies: [{"asset": "cat.drgs"}, ...]')
    _check(bodies, subject)
    touches = {(i, j): bodies[i].touch.with_other(bodies[j].touch) for i, j in combinations(range(len(bodies)), 2)}
    given: set[tuple[int, int]] = set()
    for row in reader.items("contacts") if "contacts" in reader.data else []:
        pair = _pair(row, [body.name for body in bodies])
        if pair in given:
            raise UsageError(
                f"{row.subject}, between", "names two bodies that another row has", "Remove one of the two"
            )
        given.add(pair)
        touches[pair] = _touch(row, touches[pair])
    return CoupledSettings(bodies, touches)


def _body(item: Reader, shared: Mapping[str, Any], out: Path | None) -> BodySettings:
    item.keys(dict.fromkeys((*_OWN, *KEYS)))
    if "asset" not in item.data:
        raise UsageError(item.subject, "names no asset", 'Give it one: {"asset": "cat.drgs"}')
    asset = Path(item.path("asset"))
    name = item.text("name") if "name" in item.data else asset.stem
    if not name.isprintable():
        raise UsageError(item.subject, f"has the name {name!r}", "Leave line breaks and control characters out")
    subject = f'{item.subject} "{name}"'
    own = Reader(dict(shared) | dict(item.data), subject, item.folder)
    if "out" not in item.data and (out is None or Path(name).name != name or name == ".."):
        problem = "has no folder for its frames" + (", and its name makes none" if out else "")
        remedy = 'Give it "out", or another "name"' if out else 'Give it "out", or all a folder with --out'
        raise UsageError(subject, problem, remedy)
    place = Path(item.path("out")) if "out" in item.data else Path(out or "") / name
    settings = parse_settings({k: v for k, v in own.data.items() if k not in _OWN}, subject, item.folder)
    if settings.solver != "mpm":
        problem = f"has the solver {settings.solver}, which pushes no other body"
        raise UsageError(subject, problem, "Choose mpm, or bake it alone and let it be a collider of the others")
    return BodySettings(name, asset, place, settings, _touch(own, Touch()))


def _touch(reader: Reader, default: Touch) -> Touch:
    contact = reader.choice("contact", tuple(CONTACTS)) if "contact" in reader.data else default.contact
    friction = reader.number("friction", 0, 1e6) if "friction" in reader.data else default.friction
    return Touch(contact, friction)


def _check(bodies: tuple[BodySettings, ...], subject: str) -> None:
    """Refuse bodies that cannot be baked together."""
    for body, other in combinations(bodies, 2):
        who = f'{subject}, bodies "{body.name}" and "{other.name}"'
        if (body.asset, body.out) == (other.asset, other.out):
            raise UsageError(f'{subject}, body "{other.name}"', "is listed twice", "Remove one of the two")
        if body.name == other.name:
            raise UsageError(
                f'{subject}, body "{other.name}"', "has the name of another", 'Give it a "name" of its own'
            )
        # On Windows and macOS the case of letters does not tell them apart.
        if str(body.out.resolve()).casefold() == str(other.out.resolve()).casefold():
            raise UsageError(who, f"have the same folder, {body.out}", 'Give each its own "out"')
        for key in _SAME:
            one, two = getattr(body.settings, key), getattr(other.settings, key)
            if one != two:
                raise UsageError(who, f"differ in {key}, {one} and {two}", "Set it once, beside the bodies")


def _pair(row: Reader, names: list[str]) -> tuple[int, int]:
    row.keys(dict.fromkeys(("between", "contact", "friction")))
    given = row.data.get("between")
    if isinstance(given, list) and len(given) == 2 and given[0] != given[1] and all(name in names for name in given):
        i, j = sorted(map(names.index, given))
        return i, j
    raise UsageError(f"{row.subject}, between", "is not two of the bodies", f"There are {', '.join(names)}")
