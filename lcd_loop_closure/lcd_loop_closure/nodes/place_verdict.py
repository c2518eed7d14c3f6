"""Read what place recognition says of a scan."""

import math

from lcd_common.nodes import messages
from lcd_loop_closure.place_gate import PlaceVerdict
from lcd_msgs.msg import PlaceMatchArray


def place_verdict(message: PlaceMatchArray) -> PlaceVerdict:
    """Return the verdict of an answer.

    A scan is rejected when its best match has a calibrated probability of being wrong and is not
    accepted. An empty answer (no map yet) and one without a probability (nothing is calibrated, or
    the guarantee is withdrawn) reject nothing: not knowing is no evidence against a loop.
    """
    stamp_ns = messages.stamp_ns(message.header.stamp)
    if not message.matches:
        return PlaceVerdict(stamp_ns)
    best = message.matches[0]
    probability = best.false_match_probability
    if math.isnan(probability):
        return PlaceVerdict(stamp_ns)
    if best.accepted:
        return PlaceVerdict(stamp_ns, None, probability)
    return PlaceVerdict(
        stamp_ns,
        f'place recognition does not accept its best match, place {best.place_id}: '
        f'{probability:.0%} likely to be wrong',
        probability,
    )
