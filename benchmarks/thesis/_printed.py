"""The thesis's own figures, as printed in chapter 5 and appendix F."""

LIMBS = ("head", "right_arm", "left_arm", "trunk", "left_leg", "right_leg")

# Tables 5.1 [g] and 5.2 [%], in the order of LIMBS. Erratum: the measured share of the right arm is printed as 7.75; by
# table 5.1 it is 4846 / 63982 = 7.57, with which the column adds up to 100 and table 5.5 follows.
MASS = {
    "cylinders": (5043, 3981, 4325, 19772, 8027, 8077),
    "ellipsoids": (2498, 1340, 1393, 18794, 4579, 3995),
    "measured": (4690, 4846, 4570, 29955, 9766, 10154),
}
SHARE = {
    "cylinders": (10.25, 8.09, 8.79, 40.17, 16.31, 16.41),
    "ellipsoids": (7.66, 4.11, 4.27, 57.65, 14.05, 12.26),
    "measured": (7.33, 7.57, 7.14, 46.82, 15.26, 15.87),
}
# Table 5.3 [g]: mean and sample standard deviation over the eight motions of F.1 and F.2. Erratum: the right leg of
# the jumps in F.2 is printed as 5383, the value of the fast walk beside it; with 24770 the jumps' masses add up to the
# 63.8 kg of all other motions, and the right leg's mean is the 11760 of table 5.3.
OPTIMISED = {
    "head": (999, 1915), "right_arm": (6246, 6736), "left_arm": (6960, 5786), "trunk": (18787, 19942),
    "left_leg": (18994, 14752), "right_leg": (11760, 12414),
}  # fmt: skip
# Table 5.4 [cm]: mean and standard deviation.
ZMP_ERROR = {"cylinders": (1.42, 0.90), "ellipsoids": (1.59, 0.96), "optimised": (9.08, 4.93)}
# Table F.3 [cm]: mean and standard deviation for cylinders, ellipsoids, optimisation.
ZMP_ERROR_PER_MOTION = {
    "Normal walk": ((0.77, 0.34), (0.93, 0.44), (6.61, 3.38)),
    "360° rotation": ((2.38, 3.46), (3.18, 3.06), (7.81, 5.84)),
    "Run in circle": ((1.77, 0.59), (0.97, 0.51), (17.25, 5.18)),
    "Lean": ((1.02, 0.40), (1.33, 0.79), (9.20, 4.41)),
    "Slow walk": ((0.63, 0.31), (0.74, 0.38), (1.85, 0.28)),
    "Fast walk": ((0.84, 0.42), (1.02, 0.42), (3.54, 2.02)),
    "Jumps": ((2.21, 1.05), (2.77, 1.18), (13.54, 6.74)),
    "Skip": ((1.73, 0.56), (1.80, 0.90), (12.89, 10.76)),
}
# Table F.4 [cm]: distance of the real ZMP from its support.
SUPPORT_DISTANCE = {
    "Normal walk": (2.33, 2.33), "360° rotation": (0.62, 1.81), "Run in circle": (12.8, 11.53), "Lean": (1.34, 6.20),
    "Slow walk": (0.01, 0.17), "Fast walk": (2.62, 4.86), "Jumps": (6.55, 9.47), "Skip": (3.14, 8.01),
}  # fmt: skip
SUPPORT_DISTANCE_MEAN = 3.68  # [cm], 5.6.2
# Table 5.5: cylinders, ellipsoids.
RADIUS_SCALE = {
    "head": (0.85, 0.98), "right_arm": (0.97, 1.36), "left_arm": (0.90, 1.29), "trunk": (1.08, 0.90),
    "left_leg": (0.97, 1.04), "right_leg": (0.98, 1.14),
}  # fmt: skip

# Table 5.6, [cm] (SD): mean distance of the ZMP from its support, original, corrected and balanced
BALANCED: dict[str, tuple[str, str, str]] = {
    "Walk": ("8.38 (7.78)", "10.06 (7.45)", "7.35 (7.46)"), "Jump": ("11.27 (3.66)", "11.31 (3.64)", "11.17 (3.61)"),
    "Skip": ("6.60 (7.28)", "6.61 (7.31)", "3.72 (4.51)"), "Another walk": ("4.71 (6.14)", "5.54 (6.19)", "4.73 (6.44)"),
    "Scanned body walk": ("5.11 (7.64)", "5.14 (7.64)", "4.49 (7.06)"),
}  # fmt: skip
