"""What an equinox module computed once, kept beside its fields."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar, overload

T = TypeVar("T")


class Remembering:
    """A base of modules with `remembered` properties.

    `functools.cached_property` keeps its values in the module's `__dict__`, and equinox tells the structure of a module
    by that: a program was traced anew for a body of which something had been computed, and for each that came from
    another process, since pickle does not give back the placeholders that equinox puts there (equinox 0.13).
    """

    __slots__ = ("_values",)

    def __getstate__(self) -> dict:
        return self.__dict__  # the fields: what was computed can be computed again


class remembered(Generic[T]):
    """A property that is computed once, beside the fields of a `Remembering` module."""

    def __init__(self, fn: Callable[[Any], T]):
        self.fn, self.name, self.__doc__ = fn, fn.__name__, fn.__doc__

    @overload
    def __get__(self, module: None, owner: type) -> "remembered[T]": ...
    @overload
    def __get__(self, module: Remembering, owner: type) -> T: ...
    def __get__(self, module, owner):
        if module is None:
            return self
        if not hasattr(module, "_values"):
            object.__setattr__(module, "_values", {})  # modules are frozen
        if self.name not in module._values:
            module._values[self.name] = self.fn(module)
        return module._values[self.name]
