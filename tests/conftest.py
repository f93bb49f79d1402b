"""Strict numerics for every test: double precision, no silent promotion; and the shared data where it is there."""

import os
import pathlib
import tempfile

# before jax is imported: bodies and compiled programs of a test run stay out of the user's cache
os.environ.setdefault("MOTIONFIT_CACHE", str(pathlib.Path(tempfile.gettempdir()) / f"motionfit-tests-{os.getuid()}"))

import jax
import numpy as np
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_compilation_cache_dir", os.path.join(os.environ["MOTIONFIT_CACHE"], "xla"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)

from hypothesis import settings

settings.register_profile("motionfit", deadline=None, max_examples=20, derandomize=True)
settings.load_profile("motionfit")

DATA = pathlib.Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="module", autouse=True)
def _room_for_programs():
    """A module of tests begins with room for its programs; the largest fills a quarter of what there is."""
    from motionfit._programs import make_room

    make_room(0.3)
    yield


@pytest.fixture(scope="session")
def shared_data() -> pathlib.Path:
    if not DATA.is_dir():
        pytest.skip(f"no shared data beside the project ({DATA.parent.name}/{DATA.name})")
    return DATA


@pytest.fixture(scope="session")
def heavy():
    import motionfit as mf

    return mf.load_character("builtin:heavy")


@pytest.fixture(scope="session")
def average():
    import motionfit as mf

    return mf.load_character("builtin:average")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)
