"""The folder of what can be made again: built-in bodies and programs."""

import os
import pathlib


def cache_folder() -> pathlib.Path:
    """Where motionfit keeps what it can make again: MOTIONFIT_CACHE, else the user's cache folder."""
    if chosen := os.environ.get("MOTIONFIT_CACHE"):
        return pathlib.Path(chosen)
    return pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "motionfit"


def remember(file: pathlib.Path, content: bytes) -> None:
    """Write a file of the cache completely or not at all: others may be reading or writing it."""
    partial = file.with_name(f"{file.name}.{os.getpid()}.part")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(content)
        partial.replace(file)
    except OSError:  # a cache that cannot be written costs time, nothing else
        if partial.is_file():
            partial.unlink()
