"""Speed as ratios within one run: `python -m benchmarks [-k NAME]`.

Compile and run time are told apart. The first entry is forward kinematics with its gradient on 300 frames of 31
joints, against the naive form that goes joint after joint with (frames, 4) quaternions.
"""

import argparse
import json
import platform
import time

import jax
import jax.numpy as jnp
import numpy as np

import motionfit as mf
from motionfit import rotation, samples


def naive_kinematics(skeleton, motion):
    """World positions joint after joint: what one writes first."""
    turns, places = [], []
    for joint, parent in enumerate(skeleton.parents):
        local = motion.rotations[:, joint]
        if parent < 0:
            turns.append(local)
            places.append(motion.root)
            continue
        places.append(places[parent] + rotation.rotate(turns[parent], jnp.asarray(skeleton.offsets)[joint][None]))
        turns.append(rotation.multiply(turns[parent], local))
    return jnp.stack(places, axis=1)


def timed(fn, *arguments, repeats: int = 30) -> dict[str, float]:
    """Compile time and the least and median run time [ms] of a jitted function."""
    jitted = jax.jit(fn)
    start = time.perf_counter()
    compiled = jitted.lower(*arguments).compile()
    compile_ms = 1e3 * (time.perf_counter() - start)
    jax.block_until_ready(compiled(*arguments))
    runs = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        runs.append(1e3 * (time.perf_counter() - start))
    return {"compile_ms": compile_ms, "run_ms": float(np.min(runs)), "run_median_ms": float(np.median(runs))}


def kinematics() -> dict:
    """Forward kinematics, and the gradient of a sum of squares of its positions in all rotations."""
    walk = samples.walk()[:300]
    walk = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32) if isinstance(x, np.ndarray) else x, walk)
    skeleton = walk.skeleton

    def with_rotations(rotations):
        return mf.Motion(skeleton, walk.root, rotations, walk.dt)

    def ours(rotations):
        return mf.forward_kinematics(skeleton, with_rotations(rotations)).positions_world

    def naive(rotations):
        return naive_kinematics(skeleton, with_rotations(rotations))

    np.testing.assert_allclose(ours(walk.rotations), naive(walk.rotations), atol=1e-4)
    result = {}
    for name, fn in (("level by level", ours), ("joint by joint", naive)):
        result[f"{name}, positions"] = timed(fn, walk.rotations)
        result[f"{name}, gradient"] = timed(jax.grad(lambda r, fn=fn: jnp.sum(fn(r) ** 2)), walk.rotations)
    for what in ("positions", "gradient"):
        pair = [result[f"{n}, {what}"] for n in ("joint by joint", "level by level")]
        result[f"ratio, {what}"] = {k: pair[0][k] / pair[1][k] for k in pair[0]}
    return result


ENTRIES = {"kinematics": kinematics}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-k", default="", help="only entries whose name contains this")
    options = parser.parse_args()
    print(json.dumps({"machine": platform.processor() or platform.machine(), "jax": jax.__version__,
                      "device": jax.devices()[0].platform}))  # fmt: skip
    for name, entry in ENTRIES.items():
        if options.k in name:
            for key, values in entry().items():
                print(f"{name}: {key:<30} " + "  ".join(f"{k} {v:9.3f}" for k, v in values.items()))


if __name__ == "__main__":
    main()
