"""The command line: demo, adapt, metrics, inspect, footskate.

Bad input ends with one line on stderr and status 2; a violation that is left over the tolerance with status 3.
"""

import copy
import dataclasses
import json
import math
import pathlib
import sys
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from motionfit._fit import BlockReport
    from motionfit._motion import Motion
    from motionfit._skeleton import Skeleton

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False,
                  help="Adapt motion clips to the shape of a character.")  # fmt: skip

ClipArgument = Annotated[str, typer.Argument(help="clip: .bvh, .glb, .gltf, .npz, or builtin:walk")]
ClipRoles = Annotated[
    pathlib.Path | None, typer.Option("--roles", help="JSON file that names the joints of an unknown clip by role")
]
CharacterRoles = Annotated[pathlib.Path | None, typer.Option(help="the same for characters that are files")]
CharacterArgument = Annotated[str, typer.Argument(help="character: .glb, .gltf, or builtin:average|slim|heavy|child")]


@app.command()
def demo(
    out: Annotated[pathlib.Path, typer.Option(help="folder for adapted.glb, report.json, report.png")] = pathlib.Path(
        "demo"
    ),
) -> None:
    """Adapt the built-in walk to the built-in heavy body."""
    from motionfit._types import InputError

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made a folder ({error.strerror}); choose another --out") from None
    run_adapt(
        "builtin:walk", "builtin:heavy", reference="builtin:average", out=out / "adapted.glb",
        report=out / "report.json", plot=out / "report.png",
    )  # fmt: skip


@app.command()
def adapt(
    clip: ClipArgument,
    character: CharacterArgument,
    out: Annotated[pathlib.Path, typer.Option("-o", "--out", help="output: .glb, .gltf, .bvh or .npz")],
    girth: Annotated[
        str | None, typer.Option(help="PART=SCALE,… e.g. arms=1.3,trunk=1.5; one number grows all")
    ] = None,
    reference: Annotated[str | None, typer.Option(help="the body that the clip was made for")] = None,
    blocks: Annotated[
        str | None,
        typer.Option(
            help="some of arms,legs,forearm,collisions,footskate,balance; all; or none. Left out: all but forearm, and "
            "collisions only where a hand touches the head, the other arm or hand"
        ),
    ] = None,
    objective: Annotated[str, typer.Option(help="vertex, capsule or joint")] = "vertex",
    fps: Annotated[float | None, typer.Option(help="resample the clip to this frame rate [1/s]")] = None,
    start: Annotated[float | None, typer.Option(help="cut the clip from here [s]")] = None,
    end: Annotated[float | None, typer.Option(help="cut the clip up to here [s]")] = None,
    unit: Annotated[float | None, typer.Option(help="metres per unit of a BVH file, where the guess is wrong")] = None,
    up: Annotated[str | None, typer.Option(help="up axis of a BVH file, y or z, where the guess is wrong")] = None,
    roles: ClipRoles = None,
    character_roles: CharacterRoles = None,
    report: Annotated[pathlib.Path | None, typer.Option(help="write report.json here")] = None,
    plot: Annotated[pathlib.Path | None, typer.Option(help="write report.png here")] = None,
) -> None:
    """Adapt CLIP to the shape of CHARACTER."""
    run_adapt(clip, character, girth=girth, reference=reference, blocks=blocks, objective=objective, fps=fps,
              start=start, end=end, unit=unit, up=up, roles=roles, character_roles=character_roles,
              out=out, report=report, plot=plot)  # fmt: skip


@app.command()
def metrics(
    clip: ClipArgument,
    character: CharacterArgument,
    reference_clip: Annotated[
        str | None, typer.Option(help="the source clip that fidelity is against; a file of `adapt` may hold it")
    ] = None,
    reference: Annotated[str | None, typer.Option(help="the body that the clip was made for")] = None,
    roles: ClipRoles = None,
    character_roles: CharacterRoles = None,
    json_file: Annotated[pathlib.Path | None, typer.Option("--json", help="write the measures here")] = None,
) -> None:
    """Measure CLIP on CHARACTER: penetration on volumes and skin, feet, balance, fidelity, smoothness."""
    import motionfit as mf
    from motionfit._progress import progress_bar

    body, motion = _load_body(character, character_roles), _load_clip(clip, roles=roles)
    source = motion.source_on(body.fingerprint) if reference_clip is None else _load_clip(reference_clip, roles=roles)
    if source.frame_count != motion.frame_count:
        raise mf.InputError(f"{reference_clip} has {source.frame_count} frames, {clip} has {motion.frame_count}; give "
                            "the clip that it was made from, cut and resampled alike")  # fmt: skip
    other = None if reference is None else _load_body(reference, character_roles)
    if other is not None and source is motion:
        sys.stderr.write(f"motionfit: {reference} plays {clip} itself; if that is an adapted clip, add "
                         "--reference-clip and the clip that it was made from, or what it was adapted away from "
                         "is missing in the reference\n")  # fmt: skip
    with progress_bar() as progress:
        measured = _measure_all(body, {"clip": mf.onto(motion, body.skeleton)}, mf.onto(source, body.skeleton),
                                source, other, progress)["clip"]  # fmt: skip
    if json_file is not None:
        _write_json(json_file, measured)
    _print_table({"measured": measured})


@app.command()
def inspect(file: Annotated[str, typer.Argument(help="a clip or a character")]) -> None:
    """Say what FILE holds: format, joints, roles, frames, units."""
    from motionfit.io import describe

    found = describe(file)
    roles = found.pop("roles")
    for key, value in found.items():
        text = ", ".join(value) if isinstance(value, list) else str(value)
        typer.echo(f"{key:<20} {text}")
    typer.echo(f"{'roles':<20} {', '.join(f'{r}={n}' for r, n in roles.items()) or 'none'}")


@app.command()
def footskate(
    clip: ClipArgument,
    character: CharacterArgument,
    out: Annotated[pathlib.Path, typer.Option("-o", "--out", help="output: .glb, .gltf, .bvh or .npz")],
    method: Annotated[str, typer.Option(help="root, leg-ik or adaptive")] = "root",
    labels: Annotated[pathlib.Path | None, typer.Option(help="footplants, CSV: foot,vertex,start,end")] = None,
    floor: Annotated[float | None, typer.Option(help="height that the feet shall stand on [m]")] = None,
    report: Annotated[pathlib.Path | None, typer.Option(help="write report.json here")] = None,
    plot: Annotated[pathlib.Path | None, typer.Option(help="draw the footprints before and after here")] = None,
    save_labels: Annotated[pathlib.Path | None, typer.Option(help="write the footplants that were used here")] = None,
    roles: ClipRoles = None,
    character_roles: CharacterRoles = None,
) -> None:
    """Make the planted feet of CLIP on CHARACTER hold still."""
    import numpy as np

    import motionfit as mf
    from motionfit.io import CLIPS, _ending

    _ending(out, CLIPS, "an output")
    for target in (out, report, plot, save_labels):
        if target is not None and not target.parent.is_dir():
            raise mf.InputError(f"{target}: its folder does not exist; make it first: mkdir -p {target.parent}")
    started = time.perf_counter()
    motion, body = _load_clip(clip, roles=roles), _load_body(character, character_roles)
    loaded = time.perf_counter() - started
    found = mf.remove_footskate(motion, body, method, labels=labels, floor=floor)
    solved = time.perf_counter() - started - loaded
    mf.save(out, found.motion, body)
    if save_labels is not None:
        found.plants.save(save_labels)
    feet = found.report()
    measured = {}
    for name, m in (("before", found.base), ("after", found.motion)):
        measured[name] = mf.measure(m, found.base) | {"feet": feet.pop(name)["feet"]}
    total = time.perf_counter() - started
    if report is not None:
        _write_json(report, {
            "schema": 1, "motionfit": mf.__version__, "clip": clip, "character": character, "girth": {},
            "frames": found.base.frame_count, "frame_rate": found.base.frame_rate,
            "joints": len(body.skeleton.names), "vertices": len(body.skin.vertices_bind),
            "device": "cpu", "dtype": str(np.asarray(found.motion.root).dtype),
            "time_s": {"load": loaded, "compile": 0.0, "solve": solved, "blocks": {"footskate": solved}, "total": total},
            "status": found.status, "blocks": [{"name": "footskate", "status": found.status}],
            "footskate": feet, **measured,
        })  # fmt: skip
    if plot is not None:
        from motionfit.view import footprints_picture

        footprints_picture(plot, found, f"{clip} on {body.name}: {method}")
    _print_feet(measured)
    typer.echo(f"{found.status.replace('_', ' ')} in {total:.1f} s; "
               f"wrote {', '.join(str(p) for p in (out, report, plot, save_labels) if p)}")  # fmt: skip
    if found.status != "converged":
        raise typer.Exit(3)


# --- what the commands share ------------------------------------------------------------------------------------


def run_adapt(
    clip: str, character: str, *, out: pathlib.Path, girth: str | None = None, reference: str | None = None,
    blocks: str | None = None, objective: str = "vertex", fps: float | None = None, start: float | None = None,
    end: float | None = None, unit: float | None = None, up: str | None = None, roles: pathlib.Path | None = None,
    character_roles: pathlib.Path | None = None, report: pathlib.Path | None = None, plot: pathlib.Path | None = None,
) -> None:  # fmt: skip
    """Load, adapt, measure and write; leaves with status 3 where a violation is left."""
    import jax
    import numpy as np

    import motionfit as mf
    from motionfit._progress import progress_bar
    from motionfit._types import InputError
    from motionfit.io import CLIPS, _ending
    from motionfit.shape.growth import grow, parse_girth

    _ending(out, CLIPS, "an output")
    for target in (out, report, plot):
        if target is not None and not target.parent.is_dir():
            raise InputError(f"{target}: its folder does not exist; make it first: mkdir -p {target.parent}")
    whole = {"none": (), "all": mf.adapt.BLOCKS}
    names = None
    if blocks is not None:
        names = whole.get(blocks.strip(), tuple(b.strip() for b in blocks.split(",") if b.strip()))
    scales = parse_girth(girth) if girth else {}
    started = time.perf_counter()
    motion = _load_clip(clip, unit=unit, up=up, roles=roles, start=start, end=end, fps=fps)
    body = _load_body(character, character_roles)
    other = _load_body(reference, character_roles) if reference else (body if scales else None)
    if scales:
        body = grow(body, scales)
    base = mf.onto(motion, body.skeleton)
    loaded = time.perf_counter() - started

    with progress_bar() as progress:
        compiled = _CompileClock()
        began = time.perf_counter()
        step = progress.task("adapting", None)
        fit = mf.adapt(motion, body, reference=other, blocks=names, objective=objective,
                       progress=lambda name, done, total: step(done, total)) if names != () else None  # fmt: skip
        progress.done("adapting")
        solve = time.perf_counter() - began
        motions = {"before": base, "after": base if fit is None else fit.motion}
        measured = _measure_all(body, motions, base, motion.source_on(body.fingerprint), other, progress)
    mf.save(out, motions["after"], body)
    excess = {k: m.pop("_excess") for k, m in measured.items()}
    left = measured["after"]["penetration"]["skin"]["frames_over_1cm"] > 0
    status = ("violations_left" if left else "converged") if fit is None else fit.status
    total = time.perf_counter() - started
    data = {
        "schema": 1, "motionfit": mf.__version__, "clip": clip, "character": character, "reference": reference,
        "girth": scales, "objective": objective, "frames": base.frame_count, "frame_rate": base.frame_rate,
        "joints": len(body.skeleton.names), "vertices": len(body.skin.vertices_bind),
        "device": jax.devices()[0].platform, "dtype": str(np.asarray(jax.numpy.zeros(0)).dtype),
        "time_s": {"load": loaded, "compile": compiled.seconds, "solve": max(solve - compiled.seconds, 0.0),
                   "blocks": {} if fit is None else _times(fit.history), "total": total},
        "status": status, "blocks": [] if fit is None else fit.report()["blocks"], **measured,
    }  # fmt: skip
    if report is not None:
        _write_json(report, data)
    if plot is not None:
        from motionfit.view import report_picture

        slides = [measured[k]["feet"]["slide_path_m"] for k in ("before", "after")]
        feet = "" if None in slides else ", planted feet slide {:.0f} -> {:.0f} cm".format(*(100 * s for s in slides))
        apart = _looks_apart(base)
        before, after = (dataclasses.replace(m[::apart], dt=apart * float(m.dt)) for m in (base, motions["after"]))
        report_picture(plot, body, before, after, excess["before"], excess["after"], [p.name for p in mf.shape.PAIRS],
                       f"{clip} on {body.name}: {status.replace('_', ' ')}{feet}")  # fmt: skip
    _print_table(measured)
    typer.echo(
        f"{status.replace('_', ' ')} in {total:.1f} s; wrote " + ", ".join(str(p) for p in (out, report, plot) if p)
    )
    if status != "converged" and fit is not None:
        raise typer.Exit(3)


def _times(history: Iterable["BlockReport"]) -> dict[str, float]:
    """Seconds per entry of --blocks: both arms are one of them, and both forearms."""
    seconds: dict[str, float] = {}
    for report in history:
        name = report.name.partition("_")[2]
        name = {"arm": "arms", "forearm": "forearm"}.get(name, report.name)
        seconds[name] = seconds.get(name, 0.0) + report.time_s
    return seconds


def _load_clip(clip: str, *, start=None, end=None, fps=None, **options):
    """A clip from a file, or one of the built-in samples."""
    import motionfit as mf
    from motionfit.io import trim
    from motionfit.samples import CLIPS

    if not clip.startswith("builtin:"):
        motion = mf.load_motion(clip, start=start, end=end, fps=fps, **options)
        _has_roles(clip, motion.skeleton)
        return motion
    if (name := clip.removeprefix("builtin:")) not in CLIPS:
        known = ", ".join(f"builtin:{k}" for k in CLIPS)
        raise mf.InputError(f"{clip}: no such built-in clip; there are {known}")
    return trim(CLIPS[name](), start=start, end=end, fps=fps, name=clip)


def _load_body(character: str, roles: pathlib.Path | None):
    """A character from a file, or a built-in one."""
    import motionfit as mf

    body = mf.load_character(character, roles=None if character.startswith("builtin:") else roles)
    _has_roles(character, body.skeleton)
    return body


def _has_roles(file: str, skeleton: "Skeleton") -> None:
    from motionfit._onto import REQUIRED
    from motionfit._types import InputError

    try:
        skeleton.require(*REQUIRED)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


class _CompileClock:
    """Adds up what JAX reports of the time that it compiles."""

    def __init__(self) -> None:
        import jax.monitoring

        self.seconds = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **_) -> None:
        if event.startswith("/jax/core/compile/"):
            self.seconds += duration_secs


def _looks_apart(motion: "Motion") -> int:
    """Every which frame the skin is looked at: about 15 per second, between which a limb sinks in or out by some
    millimetres."""
    return max(1, round(motion.frame_rate / 15))


def _measure_all(body, motions: dict, source, clip, reference, progress) -> dict[str, dict]:
    """An M of report.json per motion; `_excess` holds the excess depths on the skin, in every frame that was looked at,
    for the picture."""
    import motionfit as mf
    from motionfit.adapt import build_clearance, measure_standing, reference_depths, source_stance, volume_depths
    from motionfit.metrics import measure, skin_depths

    pairs = mf.shape.PAIRS
    clearance = build_clearance(body, pairs)
    limit = reference_depths(clip, body, reference, pairs)
    step = _looks_apart(next(iter(motions.values())))
    own = original = None
    if reference is not None:
        original = mf.onto(clip, reference.skeleton)
        own = skin_depths(reference, original, step=step, progress=progress.task("reference skin"))
    stance = source_stance(body, source, reference, original)
    result = {}
    for name, motion in motions.items():
        if (same := next((k for k in result if motions[k] is motion), None)) is not None:
            result[name] = copy.deepcopy(result[same])
            continue
        excess = volume_depths(clearance, motion) - limit
        skin = skin_depths(body, motion, step=step, progress=progress.task(f"skin {name}"))
        standing = measure_standing(body, motion, stance)
        result[name] = measure(motion, source, volume_excess=excess, skin=skin, reference=own,
                               feet=standing["feet"], balance=standing["balance"])  # fmt: skip
        result[name]["_excess"] = skin.depth - (0.0 if own is None else own.depth)
    return result


def _finite(value):
    """JSON has no NaN: whatever is not finite becomes null."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items() if not k.startswith("_")}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def _write_json(path: pathlib.Path, data: dict) -> None:
    from motionfit._files import whole

    with whole(path) as partial:
        partial.write_text(json.dumps(_finite(data), indent=2, allow_nan=False) + "\n", encoding="utf-8", newline="\n")


def _print_table(columns: dict[str, dict]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(show_edge=False, pad_edge=False)
    table.add_column("")
    for name in columns:
        table.add_column(name, justify="right")

    def line(label: str, *path: str, scale: float | int = 1, form: str = "{:.1f}") -> None:
        cells = []
        for m in columns.values():
            value: Any = m
            for key in path:
                value = value.get(key) if isinstance(value, dict) else None
            cells.append("-" if value is None else form.format(scale * value))
        table.add_row(label, *cells)

    line("deepest excess, skin (cm)", "penetration", "skin", "excess_max_m", scale=100)
    line("frames over 1 cm, skin (%)", "penetration", "skin", "frames_over_1cm", scale=100)
    line("skin inside other parts (%)", "penetration", "skin", "inside_ratio", scale=100, form="{:.2f}")
    line("deepest excess, volumes (cm)", "penetration", "excess_max_m", scale=100)
    line("frames over 1 cm, volumes (%)", "penetration", "frames_over_1cm", scale=100)
    line("planted foot slides, in all (cm)", "feet", "slide_path_m", scale=100)
    line("deepest under the floor (cm)", "feet", "ground_penetration_max_m", scale=100)
    line("ZMP from its support, mean (cm)", "balance", "zmp_distance_mean_m", scale=100)
    line("beyond the reference's, mean (cm)", "balance", "excess_over_reference_mean_m", scale=100)
    line("mean joint deviation (deg)", "fidelity", "joint_angle_mean_rad", scale=180 / math.pi, form="{:.2f}")
    line("forearm direction (deg)", "fidelity", "forearm_direction_mean_rad", scale=180 / math.pi)
    line("jerk ratio", "smoothness", "jerk_ratio", form="{:.3f}")
    Console(width=100).print(table)


def _print_feet(columns: dict[str, dict]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(show_edge=False, pad_edge=False)
    table.add_column("")
    for name in columns:
        table.add_column(name, justify="right")
    for label, key, scale, form in (
        ("planted foot slides, 95 % under (mm/s)", "slide_p95_m_s", 1000, "{:.1f}"),
        ("planted foot slides, in all (cm)", "slide_path_m", 100, "{:.1f}"),
        ("frames with a foot down", "contact_frames", 1, "{}"),
        ("deepest under the floor (cm)", "ground_penetration_max_m", 100, "{:.1f}"),
        ("highest over it when down (cm)", "floating_max_m", 100, "{:.1f}"),
    ):
        values = [m["feet"][key] for m in columns.values()]
        table.add_row(label, *("-" if v is None else form.format(scale * v) for v in values))
    Console(width=100).print(table)


def main() -> None:
    """Run the command line with its exit statuses."""
    from motionfit._traces import keep_programs
    from motionfit._types import InputError

    try:
        keep_programs()
        app()
    except InputError as error:
        sys.stderr.write(f"motionfit: {' '.join(str(error).split())}\n")
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        sys.stderr.write("motionfit: interrupted; nothing half-written is left\n")
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
