"""Writing glTF 2.0: a skinned character with its motion, whole in one file."""

import base64
import os
import pathlib

import numpy as np
from scipy.spatial.transform import Rotation

from motionfit._character import Character
from motionfit._files import whole
from motionfit._motion import Motion, bind_pose
from motionfit._onto import onto
from motionfit._skinning import Skin, vertex_normals
from motionfit._types import InputError
from motionfit.io.gltf import COMPONENTS, SOURCE_OF


class _Writer:
    """Collects arrays into one buffer with their accessors."""

    def __init__(self):
        self.data = bytearray()
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def add(self, array: np.ndarray, kind: str, *, target: int | None = None, bounds: bool = False) -> int:
        array = np.ascontiguousarray(array)
        self.data.extend(b"\0" * (-len(self.data) % 4))
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        if target is not None:
            view["target"] = target
        self.data.extend(array.tobytes())
        component = {v: k for k, v in COMPONENTS.items()}[array.dtype.type]
        accessor = {"bufferView": len(self.views), "componentType": component, "count": len(array), "type": kind}
        if bounds:
            flat = array.reshape(len(array), -1)
            accessor |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write_gltf(path: str | os.PathLike, motion: Motion, character: Character) -> None:
    """Write a skinned, animated character as .glb (or .gltf with the data inside), for the Khronos validator.

    The source of an adapted clip is a second animation.
    """
    import json
    from importlib.metadata import version

    skeleton, skin = character.skeleton, character.skin
    joints = len(skeleton.names)
    if motion.rotations.shape[1] != joints:
        raise InputError(f"{path}: the motion has {motion.rotations.shape[1]} joints, the character {joints}; "
                         "put it on first with motionfit.onto(motion, character.skeleton)")  # fmt: skip
    writer = _Writer()
    vertices = np.asarray(skin.vertices_bind, np.float32)
    normals = np.array(vertex_normals(vertices, np.asarray(skin.faces)), np.float32)
    lengths = np.linalg.norm(normals, axis=1)
    normals[lengths < 0.5] = (0.0, 1.0, 0.0)  # a vertex no triangle uses has none
    attributes = {
        "POSITION": writer.add(vertices, "VEC3", target=34962, bounds=True),
        "NORMAL": writer.add(normals, "VEC3", target=34962),
    }
    for k, (joint, weight) in enumerate(_influences(skin)):
        attributes[f"JOINTS_{k}"] = writer.add(joint, "VEC4", target=34962)
        attributes[f"WEIGHTS_{k}"] = writer.add(weight, "VEC4", target=34962)
    faces = np.asarray(skin.faces)
    kind = np.uint16 if len(vertices) < 65535 else np.uint32
    indices = writer.add(faces.astype(kind).reshape(-1, 1), "SCALAR", target=34963)

    positions, turns = bind_pose(skeleton)
    inverse = np.zeros((joints, 4, 4))
    back = Rotation.from_quat(turns, scalar_first=True).inv()
    inverse[:, :3, :3], inverse[:, 3, 3] = back.as_matrix(), 1.0
    inverse[:, :3, 3] = -back.apply(positions)
    inverse_bind = writer.add(inverse.transpose(0, 2, 1).reshape(joints, 16).astype(np.float32), "MAT4")

    rest = np.asarray(skeleton.rest_rotations, float)
    offsets = np.asarray(skeleton.offsets, float)
    nodes: list[dict] = []
    for j, name in enumerate(skeleton.names):
        node: dict = {"name": name, "translation": offsets[j].tolist(), "rotation": rest[j, [1, 2, 3, 0]].tolist()}
        nodes.append(node)
    ends = np.asarray(skeleton.end_offsets, float)
    for k, parent in enumerate(skeleton.end_parents):
        nodes.append({"name": f"{skeleton.names[parent]}_end{k}", "translation": ends[k].tolist()})
    for child, parent in [*enumerate(skeleton.parents), *((joints + k, p) for k, p in enumerate(skeleton.end_parents))]:
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(child)
    nodes.append({"name": character.name, "mesh": 0, "skin": 0})

    animations = [_animation(writer, "motion", motion)]
    if motion.source is not None:
        source = _animation(writer, "source", onto(motion.source.motion, skeleton))
        animations.append(source | {"extras": {SOURCE_OF: motion.source.body}})
    document: dict = {
        "asset": {"version": "2.0", "generator": f"motionfit {version('motionfit')}"},
        "scene": 0,
        "scenes": [{"nodes": [0, len(nodes) - 1]}],
        "nodes": nodes,
        "meshes": [{"name": character.name, "primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"name": "skin", "doubleSided": True,
                       "pbrMetallicRoughness": {"baseColorFactor": [0.76, 0.6, 0.51, 1.0], "metallicFactor": 0.0,
                                                "roughnessFactor": 0.8}}],
        "skins": [{"joints": list(range(joints)), "inverseBindMatrices": inverse_bind, "skeleton": 0}],
        "animations": animations,
    }  # fmt: skip
    document["accessors"], document["bufferViews"] = writer.accessors, writer.views
    binary = pathlib.Path(path).suffix.lower() == ".glb"
    buffer: dict = {"byteLength": len(writer.data)}
    if not binary:
        buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(bytes(writer.data)).decode()
    document["buffers"] = [buffer]
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    with whole(path) as partial:
        partial.write_bytes(_pack(text, bytes(writer.data)) if binary else text)


def _influences(skin: Skin):
    """Joints and weights in groups of four, greatest first, each vertex summing to one in float32."""
    joints, weights = np.asarray(skin.joints), np.asarray(skin.weights, float)
    order = np.argsort(-weights, axis=1, kind="stable")
    joints, weights = np.take_along_axis(joints, order, 1), np.take_along_axis(weights, order, 1)
    pad = -joints.shape[1] % 4
    joints, weights = (np.pad(x, ((0, 0), (0, pad))) for x in (joints, weights))
    joints = np.where(weights > 0, joints, 0)
    kind = np.uint8 if joints.max(initial=0) < 256 else np.uint16
    weights = (weights / weights.sum(1, keepdims=True)).astype(np.float32)
    for k in range(0, joints.shape[1], 4):
        if k == 0 or weights[:, k : k + 4].any():
            yield joints[:, k : k + 4].astype(kind), weights[:, k : k + 4]


def _animation(writer: _Writer, name: str, motion: Motion) -> dict:
    frames = motion.frame_count
    times = (np.arange(frames) * float(motion.dt)).astype(np.float32).reshape(-1, 1)
    time = writer.add(times, "SCALAR", bounds=True)
    samplers: list[dict] = []
    channels: list[dict] = []

    def track(values: np.ndarray, kind: str, node: int, path: str) -> None:
        output = writer.add(values.astype(np.float32), kind)
        samplers.append({"input": time, "output": output, "interpolation": "LINEAR"})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})

    track(np.asarray(motion.root, float), "VEC3", 0, "translation")
    rotations = np.asarray(motion.rotations, float)
    # q and -q are one rotation: neighbours must not lie on opposite sides, or players take the long way round
    flips = np.cumprod(np.where((rotations[1:] * rotations[:-1]).sum(-1) < 0, -1.0, 1.0), axis=0)
    rotations = np.concatenate([rotations[:1], rotations[1:] * flips[..., None]])
    rotations /= np.linalg.norm(rotations, axis=-1, keepdims=True)
    for joint in range(rotations.shape[1]):
        track(rotations[:, joint][:, [1, 2, 3, 0]], "VEC4", joint, "rotation")
        if motion.translations is not None and joint > 0:
            track(np.asarray(motion.translations, float)[:, joint], "VEC3", joint, "translation")
    return {"name": name, "samplers": samplers, "channels": channels}


def _pack(text: bytes, data: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text + len(data).to_bytes(4, "little") + b"BIN\0" + data
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks
