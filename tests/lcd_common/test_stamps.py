"""A stamp is new, repeated, late, or a sign that the clock jumped back."""

from lcd_common.stamps import StampGuard, StampVerdict


def test_the_four_verdicts() -> None:
    guard = StampGuard(tolerance_ns=100)
    stamps = [1000, 1100, 1100, 1050, 1200, 1100, 1099, 5]
    assert [guard.check(stamp) for stamp in stamps] == [
        StampVerdict.NEW,
        StampVerdict.NEW,
        StampVerdict.DUPLICATE,
        StampVerdict.LATE,
        StampVerdict.NEW,
        StampVerdict.LATE,
        StampVerdict.JUMPED_BACK,
        StampVerdict.JUMPED_BACK,
    ]
    guard.reset()
    assert guard.check(5) is StampVerdict.NEW
