"""Segment inertia of an average person: de Leva 1996.

P. de Leva, Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters, J. Biomechanics 29(9), 1996, table 4:
gamma-ray scans of 100 men and 15 women (mean age 24 and 19, 73.0 kg and 61.9 kg).
"""

from typing import NamedTuple


class Segment(NamedTuple):
    """`mass` as a share of the total; `centre` as a share of the length, from the first end point; `gyration`, the
    radii of gyration about the sagittal (front-back), transverse (left-right) and longitudinal axis over the length."""

    mass: float
    centre: float
    gyration: tuple[float, float, float]


# End points: head vertex to cervicale; trunk suprasternale to xiphion to omphalion to the hips' middle; limbs joint
# centre to joint centre; hand wrist to tip of the middle finger (dactylion); foot heel to tip of the toes.
_MALE = {
    "head": Segment(0.0694, 0.5002, (0.303, 0.315, 0.261)),
    "chest": Segment(0.1596, 0.2999, (0.716, 0.454, 0.659)),
    "spine": Segment(0.1633, 0.4502, (0.482, 0.383, 0.468)),
    "hips": Segment(0.1117, 0.6115, (0.615, 0.551, 0.587)),
    "upper_arm": Segment(0.0271, 0.5772, (0.285, 0.269, 0.158)),
    "forearm": Segment(0.0162, 0.4574, (0.276, 0.265, 0.121)),
    "hand": Segment(0.0061, 0.3624, (0.288, 0.235, 0.184)),
    "thigh": Segment(0.1416, 0.4095, (0.329, 0.329, 0.149)),
    "calf": Segment(0.0433, 0.4395, (0.251, 0.246, 0.102)),
    "foot": Segment(0.0137, 0.4415, (0.257, 0.245, 0.124)),
}
_FEMALE = {
    "head": Segment(0.0668, 0.4841, (0.271, 0.295, 0.261)),
    "chest": Segment(0.1545, 0.2077, (0.746, 0.502, 0.718)),
    "spine": Segment(0.1465, 0.4512, (0.433, 0.354, 0.415)),
    "hips": Segment(0.1247, 0.4920, (0.433, 0.402, 0.444)),
    "upper_arm": Segment(0.0255, 0.5754, (0.278, 0.260, 0.148)),
    "forearm": Segment(0.0138, 0.4559, (0.261, 0.257, 0.094)),
    "hand": Segment(0.0056, 0.3427, (0.244, 0.208, 0.154)),
    "thigh": Segment(0.1478, 0.3612, (0.369, 0.364, 0.162)),
    "calf": Segment(0.0481, 0.4352, (0.267, 0.263, 0.092)),
    "foot": Segment(0.0129, 0.4014, (0.299, 0.279, 0.139)),
}


def _sided(rows: dict[str, Segment]) -> dict[str, Segment]:
    single = ("head", "chest", "spine", "hips")
    both = {f"{side}_{k}": v for side in ("left", "right") for k, v in rows.items() if k not in single}
    return {k: rows[k] for k in single} | both


SEGMENTS: dict[str, dict[str, Segment]] = {"male": _sided(_MALE), "female": _sided(_FEMALE)}
