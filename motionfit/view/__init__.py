"""Pictures of motions, bodies and reports."""

from motionfit.view.plots import draw_body, report_picture

__all__ = ["draw_body", "report_picture"]
