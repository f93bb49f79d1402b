"""The thesis's tables and figures with our numbers beside its own: one script each, `python -m benchmarks.thesis.NAME`.

masses (5.1 to 5.3, F.1, F.2), zmp (5.4, F.3, figure 5.18), support (F.4), scales (5.5). Its captures are not public:
with `--data FOLDER` eight clips of the same kinds are used, without it the built-in bodies and walk.
"""
