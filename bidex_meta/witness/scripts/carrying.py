"""Scripted policy for an egg that the right hand can bring to its goal itself."""

from bidex_meta.witness.controller import Actions, HandController, point

# These are joint angles of the right hand in rad, before and after it closes on the egg, and the number of steps of
# closing.
_OPEN = (0.5, 0.5)
_FIST = (1.3, 1.35)
_CLOSING = 10
_THUMB = {"THJ4": 0.85, "THJ3": 1.1, "THJ1": -0.3, "THJ0": -0.6}
_SETTLING = 25  # number of steps that the hand waits below the egg before it moves
# Distance in metres of the hand's point from the egg in x while it closes; eggs escape on the thumb's side.
_ASIDE = 0.01


def carry_egg(hands: HandController) -> Actions:
    """Close the right hand on the egg and carry it to its goal; the left hand makes way."""
    # Catching a throw and then carrying the egg to the goal would be quicker, but a script cannot predict where an egg
    # flies.
    hands.bend("left", 0.0, 0.0)
    for side in ("right", "left"):
        hands.hold(side)
    while hands.steps_left:
        closed = min(1.0, hands.taken / _CLOSING)
        knuckles, middles = (first + closed * (last - first) for first, last in zip(_OPEN, _FIST, strict=True))
        hands.bend("right", knuckles, middles, **{joint: closed * angle for joint, angle in _THUMB.items()})
        egg = hands.where("object/position")
        way = hands.frozen("goal")[:3] - egg
        if hands.taken < _SETTLING:
            way = 0.0 * way
            way[0] = egg[0] - hands.at("right")[0] + _ASIDE
        x, y, z = point(hands.at("left"))
        yield from hands.lead_each((point(hands.at("right") + way), (x, y - 0.2, z)))
