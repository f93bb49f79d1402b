"""What a benchmark yields, how it is timed on a machine that others share, and when a number is a regression."""

import json
import math
import os
import pathlib
import platform
import re
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import motionfit

BASELINE = pathlib.Path(__file__).parent / "baseline.json"
SCHEMA = 1

Direction = Literal["lower", "higher", "equal"]
# fields of a metric in baseline.json; anything else (a path, a user's name) has no business there
FIELDS = ("value", "unit", "direction", "tolerance", "slack", "timed", "device", "jax")


@dataclass(frozen=True)
class Metric:
    """One number of one entry: `key` is "entry.what".

    It may be worse than the baseline, against its `direction`, by `tolerance` (a share of the baseline's value)
    plus `slack` (in `unit`, for values near zero). `tolerance=None` is printed and stored, never gated: seconds
    above all. `timed` marks what the load of the machine moves: it is measured again before it counts.
    """

    key: str
    value: float
    unit: str
    direction: Direction = "lower"
    tolerance: float | None = None
    slack: float = 0.0
    timed: bool = False

    @property
    def entry(self) -> str:
        return self.key.partition(".")[0]


def seconds(key: str, value: float, unit: str = "s") -> Metric:
    """A time as it is: printed, never gated."""
    scale = {"s": 1.0, "ms": 1e3, "us": 1e6, "ms/frame": 1e3, "us/frame": 1e6, "s/shape": 1.0}[unit]
    return Metric(key, value * scale, unit, "lower", None, 0.0, True)


def time_ratio(key: str, value: float, tolerance: float = 0.75) -> Metric:
    """A time over that of the reference work of the same minute: loose, since two cores serve many."""
    return Metric(key, value, "ratio", "lower", tolerance, 0.0, True)


class Regression(NamedTuple):
    """A metric that got worse than the baseline allows; `now` is None where the entry no longer yields it."""

    key: str
    baseline: float
    now: float | None
    unit: str
    tolerance: float
    limit: float

    def __str__(self) -> str:
        now = "missing" if self.now is None else f"{self.now:.6g}"
        return (f"{self.key}: baseline {self.baseline:.6g} {self.unit}, now {now}, "
                f"allowed {self.limit:.6g} (tolerance {self.tolerance:.0%})")  # fmt: skip


# --- comparing -------------------------------------------------------------------------------------------------


def compare(baseline: Mapping[str, Mapping], metrics: Iterable[Metric], platform_name: str = "") -> list[Regression]:
    """The regressions of some metrics against the `metrics` table of a baseline.

    The committed tolerance counts, not that of the running code: who loosens it has to commit the new baseline.
    A metric without a baseline is new and passes; one that an entry used to yield and does not any more is a
    regression. Timed metrics of another platform (a GPU against a CPU) say nothing and are left out.
    """
    metrics = list(metrics)
    found: list[Regression] = []
    for metric in metrics:
        old = baseline.get(metric.key)
        if old is None or old["tolerance"] is None:
            continue
        if old["timed"] and platform_name and not old["device"].startswith(platform_name):
            continue
        room = old["tolerance"] * abs(old["value"]) + old["slack"]
        limit = old["value"] - room if old["direction"] == "higher" else old["value"] + room
        worse = {
            "lower": metric.value > limit,
            "higher": metric.value < limit,
            "equal": abs(metric.value - old["value"]) > room,
        }[old["direction"]]
        if worse or not math.isfinite(metric.value):
            found.append(Regression(metric.key, old["value"], metric.value, old["unit"], old["tolerance"], limit))
    ran, yielded = {m.entry for m in metrics}, {m.key for m in metrics}
    for key, old in baseline.items():
        if key.partition(".")[0] in ran and key not in yielded and old["tolerance"] is not None:
            found.append(Regression(key, old["value"], None, old["unit"], old["tolerance"], old["value"]))
    return found


def load_baseline(path: pathlib.Path) -> dict[str, dict]:
    """The metrics of a baseline file; a ValueError says what is wrong with one that cannot be used."""
    data = json.loads(path.read_text(encoding="utf-8"))
    if data.get("schema") != SCHEMA:
        raise ValueError(f"{path.name} has schema {data.get('schema')}, this code reads {SCHEMA}")
    for key, entry in data["metrics"].items():
        if set(entry) != set(FIELDS):
            raise ValueError(f"{path.name}: {key} has fields {sorted(entry)}, expected {sorted(FIELDS)}")
    return data["metrics"]


def save_baseline(path: pathlib.Path, metrics: Iterable[Metric]) -> int:
    """Put metrics into a baseline file: what the same entries said before goes, other entries stay."""
    metrics = list(metrics)
    ran = {m.entry for m in metrics}
    kept = load_baseline(path) if path.exists() else {}
    kept = {k: v for k, v in kept.items() if k.partition(".")[0] not in ran}
    machine = describe_machine()
    for m in metrics:
        if not math.isfinite(m.value):
            raise ValueError(f"{m.key} is {m.value}: that cannot be a baseline")
        value = float(f"{m.value:.6g}")  # further digits are noise, and noise in diffs
        row = (value, m.unit, m.direction, m.tolerance, m.slack, m.timed, machine["device"], machine["jax"])
        kept[m.key] = dict(zip(FIELDS, row, strict=True))
    text = json.dumps({"schema": SCHEMA, "metrics": dict(sorted(kept.items()))}, indent=1)
    path.write_text(text + "\n", encoding="utf-8")
    return len(metrics)


def describe_machine() -> dict[str, str]:
    """What the numbers were measured on: no host, user or path."""
    device = jax.devices()[0]
    name = device.device_kind
    if device.platform == "cpu":
        name = platform.processor() or platform.machine()
        try:
            found = re.search(r"model name\s*:\s*(.+)", pathlib.Path("/proc/cpuinfo").read_text())
            name = found[1].strip() if found else name
        except OSError:  # not Linux
            pass
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"device": f"{device.platform}: {name}, {cores} CPU cores", "jax": jax.__version__}


def has_banded() -> bool:
    """Whether this version has the solver that is linear in the clip's length."""
    # looked for beside the package that was imported: an editable install of another tree would answer an import
    return (pathlib.Path(motionfit.__file__).parent / "banded.py").exists()


# --- timing ----------------------------------------------------------------------------------------------------


class Pace(NamedTuple):
    """Median seconds of a work and of the reference work, and the median of their ratios round by round."""

    run_s: float
    reference_s: float
    ratio: float


def _time_of(work: Callable[[], object], loops: int) -> float:
    start = time.perf_counter()
    for _ in range(loops):
        jax.block_until_ready(work())
    return (time.perf_counter() - start) / loops


def _loops(once_s: float) -> int:
    """So many calls that one measurement lasts a few milliseconds: the clock and a task switch hide in that."""
    return max(1, math.ceil(5e-3 / max(once_s, 1e-7)))


def interleaved(
    work: Callable[[], object], reference: Callable[[], object], rounds: int = 15, budget_s: float = 20.0
) -> Pace:
    """Time two works in turn, A B A B ..., after one warm-up each.

    Whatever else runs on the machine slows neighbouring measurements alike, so the ratio within a round is steady
    where seconds are not, and its median drops the rounds in which something began or ended. At least three
    rounds; then until `rounds` or the time budget is reached.
    """
    loops = []
    for fn in (work, reference):
        jax.block_until_ready(fn())
        loops.append(_loops(_time_of(fn, 1)))
    start, times = time.perf_counter(), []
    while len(times) < 3 or (len(times) < rounds and time.perf_counter() - start < budget_s):
        times.append((_time_of(work, loops[0]), _time_of(reference, loops[1])))
    a, b = np.array(times).T
    return Pace(float(np.median(a)), float(np.median(b)), float(np.median(a / b)))


def compile_s(fn: Callable, *arguments) -> float:
    """Seconds to trace and compile a function that was not compiled before."""
    start = time.perf_counter()
    jax.jit(lambda *a: fn(*a)).lower(*arguments).compile()
    return time.perf_counter() - start


def compile_reference() -> float:
    """Seconds to compile a fixed program, the gradient of forty dense layers: the yardstick of compile times."""

    def program(x, weights):
        for k in range(40):
            x = jnp.tanh(x @ weights[k]) * (k + 1.0)
        return jnp.sum(x)

    arguments = jnp.ones((8, 16), jnp.float32), jnp.ones((40, 16, 16), jnp.float32)
    return float(np.median([compile_s(jax.grad(program), *arguments) for _ in range(3)]))


class _CompileCounter:
    count = 0

    def __call__(self, event: str, duration_secs: float, **_) -> None:
        del duration_secs
        if event == "/jax/core/compile/backend_compile_duration":
            self.count += 1


_counter = _CompileCounter()
jax.monitoring.register_event_duration_secs_listener(_counter)


def compilations(work: Callable[[], object]) -> int:
    """How many programs XLA had to compile for a piece of work (jax.monitoring tells)."""
    before = _counter.count
    jax.block_until_ready(work())
    return _counter.count - before


def reset_peak_memory() -> None:
    """Forget the process's memory peak so far; Linux only, elsewhere the peak is that of the whole run."""
    try:
        pathlib.Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass


def peak_memory_gib(children: bool = False) -> float:
    """The most memory [GiB] that this process held since `reset_peak_memory`; with its `children`, those that are alive
    and their own peaks counted, an upper bound."""
    try:
        processes = ["self"]
        if children:
            lists = pathlib.Path("/proc/self/task").glob("*/children")
            processes += [pid for file in lists for pid in file.read_text().split()]
        found = [re.search(r"VmHWM:\s*(\d+) kB", pathlib.Path(f"/proc/{p}/status").read_text()) for p in processes]
        return sum(int(f[1]) for f in found if f is not None) / 2**20
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


# --- reference work in plain NumPy -----------------------------------------------------------------------------


def numpy_kinematics(parents, offsets, root, rotations) -> tuple[np.ndarray, np.ndarray]:
    """World positions [m] and rotation matrices of all joints, joint after joint in NumPy.

    Written without any of motionfit's code: it is the oracle of the fast form as well as its yardstick.
    """
    w, x, y, z = np.moveaxis(np.asarray(rotations, float), -1, 0)
    local = np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1,
    ).reshape(*w.shape, 3, 3)  # fmt: skip
    positions, turned = np.empty((*w.shape, 3)), np.empty_like(local)
    for joint, parent in enumerate(parents):
        if parent < 0:
            positions[:, joint], turned[:, joint] = root, local[:, joint]
        else:
            positions[:, joint] = positions[:, parent] + turned[:, parent] @ offsets[joint]
            turned[:, joint] = turned[:, parent] @ local[:, joint]
    return positions, turned


def fixed_work() -> Callable[[], object]:
    """A fixed amount of NumPy work, some tens of milliseconds: what whole adaptations are counted in."""
    rng = np.random.default_rng(0)
    rotations = rng.normal(size=(300, 31, 4))
    rotations /= np.linalg.norm(rotations, axis=-1, keepdims=True)
    parents, offsets = [-1, *range(30)], rng.normal(size=(31, 3))
    values = rng.normal(size=200_000)

    def work():
        numpy_kinematics(parents, offsets, np.zeros(3), rotations)
        return np.sort(np.sin(values) * np.exp(-(values**2)))[0]

    return work
