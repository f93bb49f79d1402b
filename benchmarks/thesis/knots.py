"""Where control points lie: every n frames, two per walk cycle (thesis 4.3.1), or automatically (open in thesis 6.2).

python -m benchmarks.thesis.knots [--data FOLDER] [--bodies NAME ...] [--clips NAME ...] [--out DIR]

The left arm's block of one body on walk, jump, dance and skip. Per rule: control points per control, the greatest excess
depth left on the volumes, the share of the frames over 1 cm, the jerk's ratio to the source's, and accepted steps.
Automatic are knots at the extrema of the excess depth and where it begins and ends, with more where more than 1 cm is
left. The walk-cycle rule puts one at every footstep.
"""

import argparse
import pathlib
from collections.abc import Callable

import numpy as np

import motionfit as mf
from benchmarks.thesis._setting import table
from motionfit import samples
from motionfit._control import Correction
from motionfit._motion import Motion, resample
from motionfit.adapt import build_clearance, reference_depths, volume_depths
from motionfit.adapt._clearance import probe_depths, reduced, support
from motionfit.adapt._controls import arm_controls
from motionfit.adapt._stages import SOLVE_PROBES, jerk_scale
from motionfit.metrics import TOLERANCE, derivative_ratio
from motionfit.shape.pairs import pairs_of
from motionfit.splines import Basis, bspline_basis, knots_at_extrema, knots_basis, refined_knots
from motionfit.terms import Effort, Smoothness

CLIPS = ("bvh/02_01_walk", "bvh/16_01_jump", "bvh/05_02_dance_arms_pirouette", "bvh/131_03_start_hop_stop")
ALLOWED = 0.004  # [m]
LEAST = 6  # frames between automatic knots, as many as between those of "every 0.1 s"


class Arm:
    """The left arm's block of a clip on a body, to be solved with any basis."""

    def __init__(self, clip: Motion, character: mf.Character, reference: mf.Character):
        self.character, self.base = character, mf.onto(clip, character.skeleton)
        pairs = tuple(p for p in pairs_of("arms") if p.first.startswith("left"))
        self.clearance = build_clearance(character, pairs)
        self.own = reference_depths(clip, character, reference, pairs)
        self.excess = volume_depths(self.clearance, self.base) - self.own

    def solve(self, basis: Basis) -> dict:
        controls = tuple(c for c in arm_controls(self.character, self.base, basis) if c.name.startswith("left"))
        score = support(self.clearance, probe_depths(self.clearance, self.base), self.own)
        terms = {"clearance": reduced(self.clearance, score, self.own + ALLOWED, SOLVE_PROBES), "effort": Effort(1.0),
                 "smoothness": Smoothness(jerk_scale(self.base))}  # fmt: skip
        problem = mf.Problem(self.character, self.base, terms, controls)
        block = mf.Block("arm", tuple(c.name for c in controls), max_steps=24, tolerance=1e-3)
        fit = mf.fit(problem, (block,), correction=Correction.zero(controls))
        left = (volume_depths(self.clearance, fit.motion) - self.own).max(axis=1)
        return {"points": basis.count, "left_m": float(left.max()), "over": float((left > TOLERANCE).mean()),
                "jerk": derivative_ratio(fit.motion, self.base, 3), "steps": fit.history[-1].accepted_steps,
                "residual": left}  # fmt: skip


def every(arm: Arm) -> dict:
    return arm.solve(bspline_basis(arm.base.frame_count, float(arm.base.dt), 0.1))


def walk_cycle(arm: Arm) -> dict:
    plants = mf.detect_footplants(arm.base, arm.character).plants
    last = float(arm.base.frame_count - 1)
    starts = np.array([0.0, *(p.start for p in plants if LEAST < p.start < last - LEAST), last])
    apart = np.concatenate([[True], np.diff(np.unique(starts)) >= LEAST])
    return arm.solve(knots_basis(np.unique(starts)[apart], arm.base.frame_count))


def automatic(arm: Arm) -> dict:
    demand = np.maximum(arm.excess.max(axis=1), 0.0)
    knots = knots_at_extrema(demand, LEAST, threshold=0.002)
    for _ in range(3):
        found = arm.solve(knots_basis(knots, arm.base.frame_count))
        more = refined_knots(knots, found["residual"], TOLERANCE, LEAST / 2)
        if len(more) == len(knots):
            break
        knots = more
    return found


RULES: dict[str, Callable[[Arm], dict]] = {"every 0.1 s": every, "walk cycle": walk_cycle, "automatic": automatic}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=pathlib.Path)
    parser.add_argument("--bodies", nargs="*", default=None)
    parser.add_argument("--clips", nargs="*", default=CLIPS)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("benchmark_results"))
    options = parser.parse_args()
    data = options.data
    reference = mf.load_character(data / "characters/avg_male.glb" if data else "builtin:average")
    rows = []
    for body in options.bodies or (["heavy_male"] if data else ["heavy"]):
        character = mf.load_character(data / f"characters/{body}.glb" if data else f"builtin:{body}")
        for name in options.clips if data else ("builtin:walk",):
            clip = resample(mf.load_motion(data / f"{name}.bvh"), 60.0) if data else samples.walk(cycles=2)
            arm = Arm(clip, character, reference)
            for rule, solve in RULES.items():
                found = solve(arm)
                rows.append([name, body, rule, f"{found['points']}", f"{1e2 * found['left_m']:.2f}",
                             f"{1e2 * found['over']:.1f}", f"{found['jerk'] or 0:.3f}", f"{found['steps']}"])  # fmt: skip
                print(" | ".join(rows[-1]), flush=True)
    table("Where the control points lie", ["clip", "body", "rule", "points", "left [cm]", "over 1 cm [%]", "jerk",
                                           "steps"], rows, options.out, "knots")  # fmt: skip


if __name__ == "__main__":
    main()
