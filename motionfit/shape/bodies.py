"""The built-in people: closed, skinned bodies that motionfit makes itself from published anthropometry."""

import hashlib
import inspect
import io

import numpy as np

from motionfit._cache import cache_folder, remember
from motionfit._character import Character
from motionfit._skeleton import Skeleton
from motionfit._skinning import Skin
from motionfit._types import InputError
from motionfit.shape import _body_measures, _body_surface, _body_weights
from motionfit.shape._body_measures import BUILTIN, SHAPES, BodyShape, skeleton_of
from motionfit.shape._body_surface import mesh_of
from motionfit.shape._body_weights import four_influences, weights_of


def builtin_body(name: str) -> Character:
    """One of the built-in people: average, slim, heavy, child. Made in a few seconds, then read from the cache."""
    return body(_shape(name), f"builtin:{name}")


def builtin_skeleton(name: str) -> Skeleton:
    """The skeleton of a built-in body, without making its skin."""
    return skeleton_of(_shape(name))


def _shape(name: str) -> BodyShape:
    if name not in SHAPES:
        raise InputError(f"no built-in body {name!r}; there are {', '.join(BUILTIN)}")
    return SHAPES[name]


def body(shape: BodyShape, name: str = "body") -> Character:
    """A closed, skinned body of the given measures, from the cache where it was made before."""
    skeleton = skeleton_of(shape)
    source = [inspect.getsource(made_by) for made_by in (_body_measures, _body_surface, _body_weights)]
    key = hashlib.sha256(repr((shape, source)).encode()).hexdigest()[:16]
    file = cache_folder() / f"body-{key}.npz"
    try:
        with np.load(file) as data:
            arrays = [data[k] for k in ("vertices", "faces", "joints", "weights")]
    except Exception:  # missing, cut off or unreadable: whatever it is, the body can be made again
        vertices, faces = mesh_of(shape)
        joints, weights = four_influences(weights_of(shape, vertices, skeleton.names))
        arrays = [vertices, faces.astype(np.int32), joints, weights]
        packed = io.BytesIO()
        np.savez_compressed(packed, **dict(zip(("vertices", "faces", "joints", "weights"), arrays, strict=True)))
        remember(file, packed.getvalue())
    return Character(skeleton, Skin(*arrays), name)
