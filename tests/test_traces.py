"""Traced programs are kept from one process to the next, and never taken for another."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import motionfit as mf
from motionfit import _traces
from motionfit._traces import kept


class Both(NamedTuple):
    total: jax.Array
    parts: tuple[jax.Array, ...]


class Scaled(eqx.Module):
    scale: jax.Array
    power: int = eqx.field(static=True)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(_traces, "_folder", tmp_path)
    monkeypatch.setattr(_traces, "KNOWN", _traces.KNOWN | {__name__.partition(".")[0]})
    return tmp_path


traced: list[int] = []


def _twice(y):
    return 2 * y


def _work(module: Scaled, x, offset=0.0, then=None):
    traced.append(1)
    y = module.scale * x**module.power + offset
    return Both(jnp.sum(y if then is None else then(y)), (y, -y))


def process():
    """The function as a new process has it: nothing traced, nothing compiled."""
    jax.clear_caches()
    traced.clear()
    return kept(_work, eqx.filter_jit)


def files(folder):
    return sorted(folder.glob("*.trace"))


def test_a_second_process_traces_nothing_and_finds_the_same(folder):
    module, x = Scaled(jnp.asarray(1.5), 3), np.linspace(-1.0, 2.0, 7)
    first = process()(module, x)
    assert traced == [1]
    assert len(files(folder)) == 1
    second = process()(module, x)
    assert traced == []
    assert isinstance(second, Both)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(second.parts[0], 1.5 * x**3, rtol=1e-12)
    # other numbers of the same shape are data
    np.testing.assert_allclose(process()(Scaled(jnp.asarray(2.0), 3), x + 1).parts[0], 2 * (x + 1) ** 3, rtol=1e-12)
    assert traced == []


@pytest.mark.parametrize(
    "arguments",
    [
        (Scaled(jnp.asarray(1.5), 2), np.ones(7)),  # what is static
        (Scaled(jnp.asarray(1.5), 3), np.ones(8)),  # the shape
        (Scaled(jnp.asarray(1.5), 3), np.ones(7, np.float32)),  # the type
        (Scaled(jnp.asarray(1.5), 3), np.ones(7), 1.0),  # a number that is not an array
        (Scaled(jnp.asarray(1.5), 3), np.ones(7), 0.0, _twice),  # a function that is known
    ],
)
def test_what_differs_is_traced(folder, arguments):
    process()(Scaled(jnp.asarray(1.5), 3), np.ones(7))
    jax.config.update("jax_numpy_dtype_promotion", "standard")
    try:
        found = process()(*arguments)
        again = process()(*arguments)
    finally:
        jax.config.update("jax_numpy_dtype_promotion", "strict")
    assert len(files(folder)) == 2
    module, x, *others = arguments
    expected = _work(module, jnp.asarray(x, float), *others)
    for result in (found, again):
        assert float(result.total) == pytest.approx(float(expected.total), rel=1e-6)


def test_another_setting_or_source_is_traced(folder, monkeypatch):
    module, x = Scaled(jnp.asarray(1.5), 3), np.ones(7)
    process()(module, x)
    with jax.default_matmul_precision("float32"):
        process()(module, x)
        assert traced == [1]
    monkeypatch.setattr(_traces, "_sources", lambda: "another version")
    process()(module, x)
    assert traced == [1]


def test_what_comes_from_elsewhere_is_not_kept(folder, monkeypatch):
    module, x = Scaled(jnp.asarray(1.5), 3), np.ones(7)
    mine = lambda y: 2 * y
    for _ in range(2):
        assert float(process()(module, x, 0.0, mine).total) == pytest.approx(21.0)
        assert traced  # its author may change it between two runs, and no file would tell
    monkeypatch.setattr(_traces, "KNOWN", _traces.KNOWN - {__name__.partition(".")[0]})
    process()(module, x)
    assert files(folder) == []


def test_a_damaged_file_is_made_again(folder):
    module, x = Scaled(jnp.asarray(1.5), 3), np.linspace(-1.0, 2.0, 7)
    process()(module, x)
    (file,) = files(folder)
    whole = file.read_bytes()
    for content in (whole[: len(whole) // 2], b""):
        file.write_bytes(content)
        np.testing.assert_allclose(process()(module, x).parts[0], 1.5 * x**3, rtol=1e-12)
        assert traced == [1]
        process()(module, x)
        assert traced == []
    assert not list(folder.glob("*.part"))


def test_a_program_that_calls_back_runs_all_the_same(folder):
    def host(x):
        return jax.pure_callback(lambda v: np.asarray(v) + 1, x, x)

    host.__module__ = "motionfit"
    assert float(kept(host, eqx.filter_jit)(jnp.asarray(2.0))) == 3.0
    assert files(folder) == []


def test_keep_programs_names_a_folder(tmp_path, monkeypatch):
    before = {
        k: getattr(jax.config, k) for k in ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    }
    monkeypatch.setattr(_traces, "_folder", None)
    try:
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
        mf.keep_programs()
        assert _traces._folder is None
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "by_environment"))
        mf.keep_programs()
        assert _traces._folder == tmp_path / "by_environment"
        mf.keep_programs(tmp_path / "by_name")
        assert _traces._folder == tmp_path / "by_name"
        (tmp_path / "file").write_text("")
        with pytest.raises(mf.InputError, match="cannot be made a folder"):
            mf.keep_programs(tmp_path / "file" / "inside")
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
