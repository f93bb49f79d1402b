"""Files that are written completely or not at all."""

import contextlib
import os
import pathlib
from collections.abc import Iterator

from motionfit._types import InputError


@contextlib.contextmanager
def whole(path: str | os.PathLike) -> Iterator[pathlib.Path]:
    """Where to write what becomes the file `path` at the end of the block: beside its place, then renamed.

    Raises:
        InputError: what cannot be written; nothing is left behind then.
    """
    path = pathlib.Path(path)
    partial = path.with_name(path.name + ".part")
    try:
        yield partial
        partial.replace(path)
    except BaseException as error:
        if partial.is_file():
            partial.unlink()
        if not isinstance(error, OSError):
            raise
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another path") from None
