"""The public surface: light, frozen, layered."""

import pathlib
import shutil
import subprocess
import sys

import pytest

import motionfit as mf

ROOT = pathlib.Path(__file__).parents[1]


def test_import_is_light():
    heavy = ["matplotlib", "viser", "dask", "trimesh", "skimage", "igl", "pygltflib", "typer", "rich"]
    code = f"import sys, motionfit; print([m for m in {heavy} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert found.stdout.strip() == "[]", found.stdout + found.stderr


def test_import_alone_is_free_and_names_come_at_first_use():
    code = ("import sys, motionfit as mf; print('jax' in sys.modules, 'scipy' in sys.modules);"
            "mf.rotation; print('scipy' in sys.modules, 'adapt' in dir(mf)); mf.adapt; print('scipy' in sys.modules)")  # fmt: skip
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert found.stdout.split() == ["False", "False", "False", "True", "True"], found.stdout + found.stderr
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = mf.no_such_name  # pyright: ignore[reportAttributeAccessIssue]


def test_every_public_name_is_there_and_documented():
    for name in mf.__all__:
        assert getattr(mf, name).__doc__, name


def test_adapt_is_a_verb_and_a_folder():
    assert callable(mf.adapt) and callable(mf.adapt.arms) and callable(mf.adapt.legs)


def test_imports_point_down_the_layers():
    tool = shutil.which("lint-imports", path=str(pathlib.Path(sys.executable).parent))
    if tool is None:
        pytest.skip("import-linter is not installed; pip install -e .[test]")
    run = subprocess.run([tool, "--no-cache"], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stdout
