"""Footplants: per frame which foot is down, on which vertex, and how sure that is; and their CSV file."""

import csv
import io
import os
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from motionfit._files import whole
from motionfit._skeleton import SIDES
from motionfit._types import InputError
from motionfit.feet._floor import Floor

LABELS = ("none", "left", "right", "both")
HEADER = ("foot", "vertex", "start", "end")


class Plant(NamedTuple):
    """One foot down from frame `start` to frame `end`, both included; `vertex` of the mesh, or None for any."""

    foot: str
    vertex: int | None
    start: int
    end: int


class Footplants(eqx.Module):
    """Which feet are planted in each frame: columns are left and right.

    `vertex` is the mesh vertex on which a foot stands (-1 where it is not down) and `confidence` how sure it is
    that the foot is down, 0 to 1. `primary` is the foot that carries the character (0 left, 1 right, -1 in flight):
    where both are down, one of them holds still and the other follows. `floor` is the plane that they stand on.
    """

    planted: Bool[np.ndarray, "frames 2"]
    vertex: Int[np.ndarray, "frames 2"]
    confidence: Float[np.ndarray, "frames 2"]
    primary: Int[np.ndarray, " frames"]
    floor: Floor
    dt: float = eqx.field(static=True)

    @property
    def labels(self) -> np.ndarray:
        """ "none", "left", "right" or "both" per frame."""
        return np.array(LABELS)[self.planted @ np.array([1, 2])]

    @property
    def carrier(self) -> Int[np.ndarray, " frames"]:
        """The vertex of the mesh that carries the character, -1 in flight."""
        frames = np.arange(len(self.primary))
        return np.where(self.primary >= 0, self.vertex[frames, np.maximum(self.primary, 0)], -1)

    @property
    def plants(self) -> tuple[Plant, ...]:
        """The intervals in which a foot stays down, by start. A vertex is named where it is one throughout."""
        found = []
        for foot, name in enumerate(SIDES):
            for start, end in runs(self.planted[:, foot]):
                used = np.unique(self.vertex[start : end + 1, foot])
                one = int(used[0]) if len(used) == 1 and used[0] >= 0 else None
                found.append(Plant(name, one, start, end))
        return tuple(sorted(found, key=lambda p: (p.start, p.foot)))

    def save(self, path: str | os.PathLike) -> None:
        """Write the intervals as CSV, to be corrected by hand and read again."""
        save_labels(path, self.plants)


def runs(mask: Bool[np.ndarray, " frames"]) -> list[tuple[int, int]]:
    """First and last frame of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def save_labels(path: str | os.PathLike, plants: Sequence[Plant]) -> None:
    """Write footplants as CSV: foot, vertex (a mesh index or "any"), first and last frame, both included."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(HEADER)
    writer.writerows((p.foot, "any" if p.vertex is None else p.vertex, p.start, p.end) for p in plants)
    with whole(path) as partial:
        partial.write_text(text.getvalue(), encoding="utf-8", newline="\n")


def load_labels(path: str | os.PathLike, frame_count: int, dt: float) -> tuple[Plant, ...]:
    """Read footplants from CSV with the columns foot, vertex, start, end.

    `foot` is left, right or both; `vertex` an index into the mesh, or "any". Whole numbers in `start` and `end`
    are frames, both included; numbers with a decimal point are seconds. Lines that begin with # are skipped.
    """
    try:
        text = pathlib.Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise InputError(f"{path}: labels cannot be read ({reason}); give a CSV file with {','.join(HEADER)}") from None
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if not lines or tuple(c.strip().casefold() for c in lines[0][1].split(",")) != HEADER:
        raise InputError(f"{path}: the first line of a label file must be {','.join(HEADER)}; "
                         f"found {lines[0][1][:60] if lines else 'nothing'!r}")  # fmt: skip
    plants: list[Plant] = []
    for number, line in lines[1:]:
        cells = [c.strip() for c in line.split(",")]
        where = f"{path}, line {number}"
        if len(cells) != 4:
            raise InputError(f"{where}: {len(cells)} columns, 4 are needed: foot,vertex,start,end")
        if cells[0] not in (*SIDES, "both"):
            raise InputError(f"{where}: foot {cells[0]!r} is not left, right or both")
        if cells[1] != "any" and not cells[1].isdigit():
            raise InputError(f"{where}: vertex {cells[1]!r} is not a mesh index or any")
        vertex = None if cells[1] == "any" else int(cells[1])
        start, end = (_frame(cell, dt, where) for cell in cells[2:])
        if not 0 <= start <= end or start >= frame_count:
            raise InputError(f"{where}: frames {start} to {end} do not lie in order within the clip's "
                             f"0 to {frame_count - 1}")  # fmt: skip
        for foot in SIDES if cells[0] == "both" else (cells[0],):
            plants.append(Plant(foot, vertex, start, min(end, frame_count - 1)))
    return tuple(plants)


def _frame(cell: str, dt: float, where: str) -> int:
    try:
        return round(float(cell) / dt) if "." in cell else int(cell)
    except (ValueError, OverflowError):
        raise InputError(f"{where}: {cell!r} is neither a frame (12) nor a time in seconds (0.25)") from None
