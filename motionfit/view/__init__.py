"""Pictures of motions, bodies and reports."""

from motionfit.view.feet import curves_picture, footprints_picture, reach_picture, snapshots_picture, sole_picture
from motionfit.view.plots import draw_body, report_picture

__all__ = [
    "curves_picture", "draw_body", "footprints_picture", "reach_picture", "report_picture", "snapshots_picture",
    "sole_picture",
]  # fmt: skip
