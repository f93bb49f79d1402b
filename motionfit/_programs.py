"""Compiled programs: how the large ones are compiled, and how many of them one process can hold."""

import functools
import gc
import pathlib
from collections.abc import Callable

import equinox as eqx
import jax

from motionfit._traces import kept

FULL = 0.6  # of the memory maps that a process may have; a first adaptation takes five thousand of usually 65,530


def program(fn: Callable) -> Callable:
    """A function that ends on the host, jitted so that it compiles fast: never to be called under another jit.

    XLA has emitted the fusions of a CPU through MLIR since jaxlib 0.9.1 (openxla/xla#41173 for what that costs), which
    takes a block's solve twice as long to compile as its older emitters do, and makes it no faster to run. Where
    `keep_programs` named a folder, the trace is kept there.
    """

    return kept(fn, lambda fn: eqx.filter_jit(fn, compiler_options=_options()))  # pyright: ignore[reportCallIssue]


@functools.cache
def _options() -> dict[str, bool]:
    """What XLA is told; nothing where it no longer knows the switch. Asked for late: it starts JAX's backend."""
    options = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda x: x, compiler_options=options).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return options


def make_room(full: float = FULL) -> bool:
    """Let go of all compiled programs where their memory maps come near to what Linux allows a process.

    XLA keeps three maps for every kernel that it compiles for a CPU, a hundred kernels to a program, and past
    `vm.max_map_count` the next program ends in a segmentation fault. So a process that adapts clips of many lengths to
    bodies of many topologies compiles some of its programs again, instead of dying. Says whether it did.
    """
    try:
        most = int(pathlib.Path("/proc/sys/vm/max_map_count").read_text())
        held = pathlib.Path("/proc/self/maps").read_bytes().count(b"\n")
    except (OSError, ValueError):  # not Linux: no such limit
        return False
    if held < full * most:
        return False
    jax.clear_caches()
    gc.collect()  # what is in a cycle would keep its maps
    return True
