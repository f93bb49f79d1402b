"""The table of body parts that are kept from sinking into each other, the adjacent ones above all.

Thesis 2.8 and 4.4 to 4.5. The first part moves away from the second; `block` is the one that takes care of it.
"""

from typing import NamedTuple

from motionfit._skeleton import SIDES


class Pair(NamedTuple):
    first: str
    second: str
    block: str

    @property
    def name(self) -> str:
        return f"{self.first}/{self.second}"

    @property
    def adjacent(self) -> bool:
        """Whether the two parts meet at a joint, so that some overlap is the joint's own."""
        return self.first.endswith("upper_arm") or self.second.endswith("thigh") and self.first.endswith("thigh")


PAIRS: tuple[Pair, ...] = (
    *(
        Pair(f"{side}_{part}", second, "arms")
        for side in SIDES
        for part, second in (
            ("upper_arm", "torso"),
            ("forearm", "torso"),
            ("hand", "torso"),
            ("forearm", f"{side}_thigh"),
            ("hand", f"{side}_thigh"),
        )
    ),
    Pair("left_thigh", "right_thigh", "legs"),
    Pair("left_calf", "right_calf", "legs"),
)


def pairs_of(*blocks: str) -> tuple[Pair, ...]:
    """The pairs that some blocks take care of, in the table's order."""
    return tuple(p for p in PAIRS if p.block in blocks)
