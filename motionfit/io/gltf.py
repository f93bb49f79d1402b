"""Reading glTF 2.0, .glb and .gltf: skinned characters and animations, through pygltflib's schema."""

import base64
import dataclasses
import os
import pathlib
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from motionfit._character import Character
from motionfit._motion import Motion, Source
from motionfit._skeleton import Skeleton
from motionfit._skinning import Skin
from motionfit._types import InputError
from motionfit.io._rest_pose import split_rest_frame
from motionfit.io.bvh import unreadable

COMPONENTS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
SOURCE_OF = "motionfit_source_on"  # extras of an animation: the body that the first one was adapted to
SINGLE = 1e-6  # what single precision leaves of zero in a product of matrices
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


class _Document:
    """A parsed file: its schema, and its accessors as arrays."""

    def __init__(self, path: str | os.PathLike):
        import json

        import pygltflib

        self.path = pathlib.Path(path)
        try:
            raw = self.path.read_bytes()
        except OSError as error:
            raise InputError(unreadable(path, error)) from None
        self.blob = b""
        text = raw
        if raw[:4] == b"glTF":
            text = self._chunks(raw)
        try:
            described = json.loads(text)
            assert isinstance(described, dict) and "asset" in described
            with warnings.catch_warnings():
                # the schema classes warn of every optional field that a file leaves out
                warnings.simplefilter("ignore", RuntimeWarning)
                self.gltf: Any = pygltflib.GLTF2.gltf_from_json(json.dumps(described))
        except (ValueError, AssertionError, UnicodeDecodeError, TypeError, KeyError, AttributeError):
            raise self.fail("no glTF 2.0 file (its JSON cannot be read); export it again as .glb") from None
        self.buffers = [self._buffer(k) for k in range(len(self.gltf.buffers))]

    def fail(self, what: str) -> InputError:
        return InputError(f"{self.path}: {what}")

    def _chunks(self, raw: bytes) -> bytes:
        if len(raw) < 20 or int.from_bytes(raw[8:12], "little") > len(raw):
            announced = int.from_bytes(raw[8:12], "little") if len(raw) >= 12 else "more"
            raise self.fail(f"the file is cut off: {announced} bytes announced, {len(raw)} found")
        if int.from_bytes(raw[4:8], "little") != 2:
            raise self.fail(f"glTF version {int.from_bytes(raw[4:8], 'little')}; only version 2 is read")
        at, text = 12, b""
        while at + 8 <= len(raw):
            size, kind = int.from_bytes(raw[at : at + 4], "little"), raw[at + 4 : at + 8]
            body = raw[at + 8 : at + 8 + size]
            if kind == b"JSON":
                text = body
            elif kind == b"BIN\0":
                self.blob = body
            at += 8 + size
        return text

    def _buffer(self, index: int) -> bytes:
        uri = self.gltf.buffers[index].uri
        if uri is None:
            return self.blob
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.split(",", 1)[1])
            except (IndexError, ValueError):
                raise self.fail(f"buffer {index}: its data URI cannot be decoded") from None
        from urllib.parse import unquote

        beside = self.path.parent / unquote(uri)
        try:
            return beside.read_bytes()
        except OSError:
            raise self.fail(f"buffer {index}: the file {uri!r} beside it is missing; keep both together") from None

    def array(self, index: int | None, what: str) -> np.ndarray:
        """An accessor as (count, width), normalised integers as floats."""
        try:
            if index is None:
                raise IndexError
            accessor = self.gltf.accessors[index]
            dtype, width = np.dtype(COMPONENTS[accessor.componentType]), WIDTHS[accessor.type]
            if accessor.bufferView is None:
                data = np.zeros((accessor.count, width), dtype)
            else:
                data = self._view(accessor.bufferView, accessor.byteOffset or 0, accessor.count, width, dtype)
            if accessor.sparse is not None:
                s = accessor.sparse
                at = self._view(s.indices.bufferView, s.indices.byteOffset or 0, s.count, 1,
                                np.dtype(COMPONENTS[s.indices.componentType]))  # fmt: skip
                data = data.copy()
                data[at[:, 0]] = self._view(s.values.bufferView, s.values.byteOffset or 0, s.count, width, dtype)
        except (IndexError, KeyError, ValueError, TypeError) as error:
            detail = f" ({error})" if isinstance(error, ValueError) else ""
            raise self.fail(f"{what}: accessor {index} is missing, of unknown type or reaches outside of its buffer"
                            f"{detail}; the file seems damaged") from None  # fmt: skip
        if accessor.normalized and dtype.kind in "iu":
            return np.maximum(data.astype(float) / np.iinfo(dtype).max, -1.0)
        return data

    def _view(self, view: int, offset: int, count: int, width: int, dtype: np.dtype) -> np.ndarray:
        v = self.gltf.bufferViews[view]
        data = self.buffers[v.buffer]
        start, size = (v.byteOffset or 0) + offset, width * dtype.itemsize
        stride = v.byteStride or size
        if count and start + (count - 1) * stride + size > len(data):
            raise ValueError(f"needs byte {start + (count - 1) * stride + size} of {len(data)}")
        rows = np.lib.stride_tricks.as_strided(
            np.frombuffer(data, np.uint8, offset=min(start, len(data))), (count, size), (stride, 1)
        )
        return np.ascontiguousarray(rows).view(dtype.newbyteorder("<")).reshape(count, width)

    # --- nodes ---

    def local(self, node: int) -> tuple[np.ndarray, Rotation, np.ndarray]:
        """Translation, rotation and scale of a node."""
        n = self.gltf.nodes[node]
        if n.matrix is not None:
            matrix = np.array(n.matrix, float).reshape(4, 4).T
            scale = np.linalg.norm(matrix[:3, :3], axis=0)
            return matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3] / np.maximum(scale, 1e-12)), scale
        rotation = np.array(n.rotation or [0, 0, 0, 1], float)
        if not np.isfinite(rotation).all() or np.linalg.norm(rotation) < 1e-6:
            raise self.fail(f"node {n.name or node!r} has no usable rotation {n.rotation}")
        return (np.array(n.translation or [0, 0, 0], float), Rotation.from_quat(rotation),
                np.array(n.scale or [1, 1, 1], float))  # fmt: skip

    def parents(self) -> dict[int, int]:
        result: dict[int, int] = {}
        for parent, node in enumerate(self.gltf.nodes):
            for child in node.children or []:
                if child in result or not 0 <= child < len(self.gltf.nodes):
                    raise self.fail(f"node {child} has two parents or does not exist; the node tree is broken")
                result[child] = parent
        for node in result:
            seen = {node}
            while node in result:
                node = result[node]
                if node in seen:
                    raise self.fail(f"the nodes form a loop at {self.gltf.nodes[node].name or node!r}")
                seen.add(node)
        return result

    def global_matrix(self, node: int, parents: Mapping[int, int]) -> np.ndarray:
        translation, rotation, scale = self.local(node)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix() * scale, translation
        return self.global_matrix(parents[node], parents) @ matrix if node in parents else matrix

    def skin_index(self) -> int:
        """The skin with the most vertices."""
        if not self.gltf.skins:
            raise self.fail("holds no skin; export the character with its armature and skin weights")
        counts = [0] * len(self.gltf.skins)
        for node in self.gltf.nodes:
            if node.skin is not None and node.mesh is not None and node.skin < len(counts):
                for primitive in self.gltf.meshes[node.mesh].primitives:
                    if primitive.attributes.POSITION is not None:
                        counts[node.skin] += self.gltf.accessors[primitive.attributes.POSITION].count
        return int(np.argmax(counts))


class _Rig:
    """The joints of a file in an order with parents first, and the skeleton that they make."""

    def __init__(self, document: _Document, roles: Mapping[str, str] | None):
        self.document = document
        self.parents = document.parents()
        skin = document.gltf.skins[document.skin_index()]
        joints = list(skin.joints or [])
        if not joints:
            raise document.fail("its skin names no joints")
        if min(joints) < 0 or max(joints) >= len(document.gltf.nodes):
            raise document.fail(f"its skin names node {max(joints)}, but there are {len(document.gltf.nodes)}")
        self.skin_joints = joints
        # nodes between two joints are joints too: what they do to the limb must not get lost
        nodes = set(joints)
        for joint in joints:
            path, node = [], joint
            while node in self.parents:
                node = self.parents[node]
                path.append(node)
                if node in joints:
                    nodes.update(path)
        roots = [n for n in nodes if self.parents.get(n) not in nodes]
        if len(roots) > 1:
            raise document.fail(f"its skin has {len(roots)} root joints "
                                f"({', '.join(self._name(n) for n in roots)}); join them under one")  # fmt: skip
        self.nodes: list[int] = []
        stack = [roots[0]]
        while stack:
            node = stack.pop()
            self.nodes.append(node)
            stack.extend(n for n in reversed(document.gltf.nodes[node].children or []) if n in nodes)
        self.world, self.mesh_to_world = self._bind(skin)
        self.scale = np.linalg.norm(self.world[:, :3, 0], axis=1)
        if np.ptp(np.linalg.norm(self.world[:, :3, :3], axis=1)) > 1e-3 * self.scale.max():
            raise document.fail("its joints are scaled unevenly; apply the scale before exporting")
        self.skeleton = self._skeleton(roles)

    def _name(self, node: int) -> str:
        return self.document.gltf.nodes[node].name or f"node_{node}"

    def _bind(self, skin) -> tuple[np.ndarray, np.ndarray]:
        """World matrices of the joints at bind, and the one that takes mesh coordinates there."""
        document = self.document
        default = np.stack([document.global_matrix(n, self.parents) for n in self.nodes])
        if skin.inverseBindMatrices is None:
            return default, np.eye(4)
        inverse = document.array(skin.inverseBindMatrices, "inverse bind matrices").astype(float)
        if inverse.shape != (len(self.skin_joints), 16):
            raise document.fail(f"{len(self.skin_joints)} joints but {len(inverse)} inverse bind matrices")
        inverse = inverse.reshape(-1, 4, 4).transpose(0, 2, 1)
        if not np.isfinite(inverse).all() or (np.abs(np.linalg.det(inverse)) < 1e-12).any():
            raise document.fail("an inverse bind matrix cannot be inverted")
        # the mesh's own placement does not count in glTF; the first joint tells where its coordinates lie
        place = default[self.nodes.index(self.skin_joints[0])] @ inverse[0]
        if np.abs(place - np.eye(4)).max() < SINGLE:
            place = np.eye(4)  # so that what was written is read back to the bit
        of_node = {n: place @ np.linalg.inv(m) for n, m in zip(self.skin_joints, inverse, strict=True)}
        world = []
        for k, node in enumerate(self.nodes):
            if node in of_node:
                world.append(of_node[node])
            else:  # between joints: as it stands below its parent
                parent = self.nodes.index(self.parents[node])
                world.append(world[parent] @ np.linalg.inv(default[parent]) @ default[k])
        return np.stack(world), place

    def _skeleton(self, roles: Mapping[str, str] | None) -> Skeleton:
        parents = [self.nodes.index(self.parents[n]) if self.parents.get(n) in self.nodes else -1 for n in self.nodes]
        turns = Rotation.from_matrix(self.world[:, :3, :3] / self.scale[:, None, None])
        places = self.world[:, :3, 3]
        offsets, rest = places.copy(), turns.as_quat(scalar_first=True)
        for k, parent in enumerate(parents):
            if parent >= 0:
                offsets[k] = turns[parent].inv().apply(places[k] - places[parent])
                rest[k] = (turns[parent].inv() * turns[k]).as_quat(scalar_first=True)
        # end sites: leaves that hang below a joint without being one
        gltf, ends = self.document.gltf, []
        for k, node in enumerate(self.nodes):
            for child in gltf.nodes[node].children or []:
                below = gltf.nodes[child]
                if child not in self.nodes and below.mesh is None and not below.children and below.camera is None:
                    ends.append((k, self.document.local(child)[0] * self.scale[k]))
        try:
            return Skeleton(
                [self._name(n) for n in self.nodes], parents, offsets, rest, roles=roles,
                end_parents=[k for k, _ in ends], end_offsets=np.array([e for _, e in ends]).reshape(-1, 3),
            )  # fmt: skip
        except InputError as error:
            raise self.document.fail(str(error)) from None


def read_character(path: str | os.PathLike, *, roles: Mapping[str, str] | None = None) -> Character:
    """The skinned character of a glTF file, in its bind pose, metres, y up."""
    document = _Document(path)
    rig = _Rig(document, roles)
    gltf, skin = document.gltf, document.skin_index()
    to_index = np.array([rig.nodes.index(n) for n in rig.skin_joints])
    parts = []
    for node in gltf.nodes:
        if node.mesh is None or node.skin != skin:
            continue
        for primitive in gltf.meshes[node.mesh].primitives:
            if primitive.mode not in (None, 4):
                raise document.fail(f"a mesh of mode {primitive.mode} was found; only triangles (4) are read")
            parts.append(_primitive(document, primitive, to_index))
    if not parts:
        raise document.fail("its skin moves no mesh; export the mesh with its armature")
    counts = np.cumsum([0] + [len(p[0]) for p in parts])
    influences = max(p[1].shape[1] for p in parts)

    def widen(x):
        return np.pad(x, ((0, 0), (0, influences - x.shape[1])))

    vertices = np.concatenate([p[0] for p in parts])
    joints = np.concatenate([widen(p[1]) for p in parts])
    weights = np.concatenate([widen(p[2]) for p in parts])
    faces = np.concatenate([p[3] + start for p, start in zip(parts, counts, strict=False)])
    vertices = vertices @ rig.mesh_to_world[:3, :3].T + rig.mesh_to_world[:3, 3]
    try:
        if not np.isfinite(vertices).all():
            raise InputError(
                f"vertex {int(np.argwhere(~np.isfinite(vertices))[0][0])} has a position that is not finite"
            )
        vertices, faces, joints, weights = _weld(vertices, faces, joints, weights)
        return Character(rig.skeleton, Skin(vertices, faces, joints, weights), pathlib.Path(path).stem)
    except InputError as error:
        raise document.fail(str(error)) from None


def _primitive(document: _Document, primitive, to_index: np.ndarray):
    attributes = primitive.attributes
    vertices = document.array(attributes.POSITION, "positions").astype(float)
    if vertices.shape[1] != 3:
        raise document.fail("positions are not three numbers each")
    joints, weights = [], []
    for k in range(4):
        at_joints, at_weights = (getattr(attributes, f"{n}_{k}", None) for n in ("JOINTS", "WEIGHTS"))
        if at_joints is None or at_weights is None:
            break
        joints.append(document.array(at_joints, f"JOINTS_{k}").astype(np.int64))
        weights.append(document.array(at_weights, f"WEIGHTS_{k}").astype(float))
    if not joints:
        raise document.fail("its mesh has no skin weights (JOINTS_0, WEIGHTS_0); bind it to the armature")
    joint, weight = np.concatenate(joints, 1), np.concatenate(weights, 1)
    if len(joint) != len(vertices) or len(weight) != len(vertices):
        raise document.fail(f"{len(vertices)} positions but {len(joint)} JOINTS and {len(weight)} WEIGHTS")
    used = weight > 0
    if used.any() and joint[used].max() >= len(to_index):
        raise document.fail(f"a vertex names joint {int(joint[used].max())}, but the skin has {len(to_index)}")
    joint = np.where(used, to_index[np.minimum(joint, len(to_index) - 1)], 0)
    sums = weight.sum(-1, keepdims=True)
    if np.isfinite(weight).all() and (sums > 0).all():
        weight = weight / sums  # quantised weights sum to one only nearly
    if primitive.indices is None:
        faces = np.arange(len(vertices) // 3 * 3)
    else:
        faces = document.array(primitive.indices, "indices").astype(np.int64).ravel()
    if len(faces) % 3 or (len(faces) and faces.max() >= len(vertices)):
        raise document.fail("its triangle indices are broken: not three each, or beyond the last vertex")
    return vertices, joint, weight, faces.reshape(-1, 3)


def _weld(vertices, faces, joints, weights):
    """Merge vertices that UV or normal seams have split: same place, same weights. Order is kept."""
    _, first, inverse = np.unique(
        np.concatenate([np.round(vertices, 7), np.round(weights, 5), joints], axis=1),
        axis=0, return_index=True, return_inverse=True,
    )  # fmt: skip
    if len(first) == len(vertices):
        return vertices, faces, joints.astype(np.int32), weights
    order = np.argsort(first)
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    keep = first[order]
    faces = rank[inverse.reshape(-1)][faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return vertices[keep], faces[whole], joints[keep].astype(np.int32), weights[keep]


def read_motion(path: str | os.PathLike, *, rest_frame: str = "auto", roles: Mapping[str, str] | None = None) -> Motion:
    """The first animation of a glTF file, sampled at the rate of its keys, on its skin's skeleton.

    One that `write_gltf` marked as what the first was adapted from becomes its source.
    """
    document = _Document(path)
    rig = _Rig(document, roles)
    if not document.gltf.animations:
        raise document.fail("holds no animation; export it with its animation, or give a .bvh")
    motion = _sampled(document, rig, document.gltf.animations[0], rest_frame)
    for animation in document.gltf.animations[1:]:
        body = animation.extras.get(SOURCE_OF) if isinstance(animation.extras, dict) else None
        source = None if body is None else _sampled(document, rig, animation, rest_frame)
        if source is not None and source.frame_count == motion.frame_count:
            motion = dataclasses.replace(motion, source=Source(source, str(body)))
    return motion


def _sampled(document: _Document, rig: _Rig, animation, rest_frame: str) -> Motion:
    tracks: dict[tuple[int, str], tuple] = {}
    keys = []
    for channel in animation.channels:
        if channel.target.node not in rig.nodes or channel.target.path not in ("rotation", "translation"):
            continue
        sampler = animation.samplers[channel.sampler]
        times = document.array(sampler.input, "animation times").astype(float).ravel()
        values = document.array(sampler.output, "animation values").astype(float)
        mode = sampler.interpolation or "LINEAR"
        needed = len(times) * (3 if mode == "CUBICSPLINE" else 1)
        if len(times) == 0 or len(values) != needed or (np.diff(times) <= 0).any() or not np.isfinite(values).all():
            raise document.fail(f"the animation of {rig._name(channel.target.node)!r} has {len(times)} rising key "
                                f"times but {len(values)} finite values; export it again")  # fmt: skip
        tracks[rig.nodes.index(channel.target.node), channel.target.path] = (times, values, mode)
        keys.append(times)
    if not keys:
        raise document.fail("its animation moves no joint of the skin")
    start, end = min(k[0] for k in keys), max(k[-1] for k in keys)
    steps = np.concatenate([np.diff(k) for k in keys])
    rate = _frame_rate(steps)
    times = start + np.arange(max(1, round((end - start) * rate) + 1)) / rate
    above = np.eye(4)
    if (parent := rig.parents.get(rig.nodes[0])) is not None:
        above = document.global_matrix(parent, rig.parents)
    above_scale = np.linalg.norm(above[:3, 0])
    above_turn = Rotation.from_matrix(above[:3, :3] / above_scale)

    rotations = np.empty((len(times), len(rig.nodes), 4))
    places = np.empty((len(times), len(rig.nodes), 3))
    for k, node in enumerate(rig.nodes):
        translation, turn, _ = document.local(node)
        places[:, k] = _sample(tracks.get((k, "translation")), times, translation)
        rotations[:, k] = _sample(tracks.get((k, "rotation")), times, turn.as_quat(), is_rotation=True)[:, [3, 0, 1, 2]]
        places[:, k] *= rig.scale[rig.skeleton.parents[k]] if k else above_scale
    root = above_turn.apply(places[:, 0]) + above[:3, 3]
    turned = above_turn * Rotation.from_quat(rotations[:, 0], scalar_first=True)
    rotations[:, 0] = turned.as_quat(scalar_first=True)
    offsets = np.asarray(rig.skeleton.offsets, float)
    moving = np.abs(places[:, 1:] - offsets[1:]).max(initial=0.0) > 1e-4
    motion = Motion(rig.skeleton, root, rotations, np.asarray(1.0 / rate), places if moving else None)
    cut = split_rest_frame(motion, rest_frame)
    # the skin's bind pose stays the rest pose: the frame is only taken out of the motion
    return Motion(rig.skeleton, cut.root, cut.rotations, cut.dt, cut.translations)


def _frame_rate(steps: np.ndarray) -> float:
    """Frames per second of key times: their usual step, as a whole number where it is one within float32."""
    if len(steps) == 0:
        return 30.0
    rate = 1.0 / float(np.median(steps))
    if rate < 15:  # sparse keys: sample them finely enough to see the curves between
        rate = 30.0
    return float(round(rate)) if abs(rate - round(rate)) < 1e-3 * rate else rate


def _sample(track, times: np.ndarray, constant: np.ndarray, is_rotation: bool = False) -> np.ndarray:
    """A channel at the given times [s]: STEP, LINEAR (slerp for rotations) or CUBICSPLINE; held past its ends."""
    if track is None:
        return np.tile(constant, (len(times), 1))
    keys, values, mode = track
    times = np.clip(times, keys[0], keys[-1])
    if mode == "CUBICSPLINE":
        before, point, after = values[0::3], values[1::3], values[2::3]
        if len(keys) == 1:
            return np.tile(point[0] / (np.linalg.norm(point[0]) if is_rotation else 1.0), (len(times), 1))
        result = np.empty((len(times), values.shape[1]))
        span = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 2)
        for k in np.unique(span):  # in- and out-tangent differ at a key, so each span is its own spline
            spline = CubicHermiteSpline(keys[k : k + 2], point[k : k + 2], np.stack([after[k], before[k + 1]]))
            result[span == k] = spline(times[span == k])
    elif mode == "STEP" or len(keys) == 1:
        result = values[np.clip(np.searchsorted(keys, times + 1e-6, side="right") - 1, 0, len(keys) - 1)]
    elif is_rotation:
        return Slerp(keys, Rotation.from_quat(values))(times).as_quat()
    else:
        result = np.stack([np.interp(times, keys, column) for column in values.T], axis=1)
    return result / np.linalg.norm(result, axis=1, keepdims=True) if is_rotation else result
