"""The thesis's tables and figures with our numbers beside its own: one script each, `python -m benchmarks.thesis.NAME`.

masses (5.1 to 5.3, F.1, F.2), zmp (5.4, F.3, figures 5.17 and 5.18), support (F.4), scales (5.5), balance (5.6, figure
5.19), valley (figure 4.9), postures (figures 5.8 to 5.15), knots, and pipeline, the whole procedure on clips of all kinds.
Its captures are not public: with `--data FOLDER` clips of the same kinds are used, without it the built-in bodies and
walk.
"""
