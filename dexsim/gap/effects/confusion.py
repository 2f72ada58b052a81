"""Classes of effects that some recordings cannot tell apart, each with the experiment that does.

An effect names the classes that it belongs to; only members of one class may be reported as a set.
"""

CLASSES: dict[str, str] = {
    "friction or play": "small reversals about a pose while a load holds the joint to one side, then without it, "
    "and very slow ramps (both encoders logged if there are two)",
    "late": "steps of two sizes and a fast chirp: a delay shifts the motion, a lag rounds it",
    "with speed": "constant speeds from slow to fast, and steps against a known load",
    "static load": "static poses while a known weight is held",
    "friction and load": "the same slow motion under two or more loads",
    "drive weakens": "this joint alone, then with the others loaded, cold and warm in random order",
    "zero or gravity": "static poses over the whole range, and the same with the mechanism turned over: "
    "what gravity does changes sign, an encoder's zero stays",
    "limits at speed": "large steps at full speed, and stops from it: one limit acts while driving, the other while braking",
    "loop": "constant speeds from slow to fast, steps of several sizes and long holds against a known load",
    "about a reversal": "reversals of increasing size about a pose, without a load and with one that holds the joint to a side",
    "weight or push": "static poses over the whole range, twice, with nothing in reach",
}
TOUCH_CLASSES = ("how hard it is touched", "how touch changes with time")
"""Of touch: the first one's own experiment tells its members apart."""
