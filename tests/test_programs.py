"""Compiled programs go before there are more of them than a process may hold."""

import pathlib

import jax
import jax.numpy as jnp
import pytest

import motionfit as mf
from motionfit import samples
from motionfit._programs import make_room

pytestmark = pytest.mark.skipif(not pathlib.Path("/proc/self/maps").exists(), reason="only Linux counts memory maps")


def _maps() -> int:
    return pathlib.Path("/proc/self/maps").read_bytes().count(b"\n")


def test_programs_are_kept_as_long_as_there_is_room():
    traces = []
    program = jax.jit(lambda x: traces.append(1) or x + 1)
    program(1.0)
    assert not make_room()
    program(2.0)
    assert len(traces) == 1


def test_programs_and_their_maps_go_where_there_is_none():
    programs = [jax.jit(lambda x, k=k: jnp.sort(jnp.sin(x * k)) @ x) for k in range(30)]
    for program in programs:
        program(jnp.arange(50.0))
    before = _maps()
    assert make_room(full=0.0)
    assert _maps() < before - 30
    assert programs[3](jnp.ones(4)) == pytest.approx(4 * float(jnp.sin(3.0)))  # compiled again


def test_adapt_makes_room(monkeypatch, average):
    asked = []
    monkeypatch.setattr("motionfit.adapt._procedure.make_room", lambda: asked.append(1))
    mf.adapt(samples.walk(cycles=1)[:16], average, blocks=("footskate",))
    assert asked
