"""Room for compiled programs: how many of them one process can hold."""

import gc
import pathlib

import jax

FULL = 0.6  # of the memory maps that a process may have; a first adaptation takes five thousand of usually 65,530


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
