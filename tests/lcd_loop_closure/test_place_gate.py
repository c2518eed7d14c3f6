"""Check when keyframes leave the gate, and with which verdict."""

from lcd_loop_closure.place_gate import PlaceGate, PlaceGateConfig, PlaceVerdict

MS = 1_000_000


class Released:
    def __init__(self, **settings):
        self.out = []
        self.gate = PlaceGate(
            PlaceGateConfig(use=True, **settings),
            lambda item, verdict: self.out.append((item, verdict and verdict.rejected)),
        )

    def answer(self, ms, rejected=None):
        self.gate.answer(PlaceVerdict(ms * MS, rejected))

    def hold(self, ms):
        self.gate.hold(ms * MS, ms)

    def time(self, ms):
        self.gate.time(ms * MS)


def test_an_item_waits_for_its_own_answer():
    released = Released()
    released.hold(100)
    released.time(200)
    assert released.out == []
    released.answer(100, 'no')
    assert released.out == [(100, 'no')]


def test_an_answer_that_came_first_is_there_already():
    released = Released()
    released.answer(100, 'no')
    released.hold(100)
    assert released.out == [(100, 'no')]


def test_an_answer_that_comes_too_late_finds_nobody():
    released = Released(wait=0.5)
    released.hold(100)
    released.time(600)
    assert released.out == []  # exactly the wait
    released.time(601)
    assert released.out == [(100, None)]
    released.answer(100, 'no')
    released.hold(700)
    released.answer(700)
    assert released.out == [(100, None), (700, None)]


def test_a_later_answer_says_that_this_one_was_left_out():
    released = Released(window=0.25)
    released.answer(100, 'first')
    released.hold(200)
    released.hold(400)
    assert released.out == []
    released.answer(500, 'second')
    assert released.out == [(200, 'first'), (400, 'second')]
    released.hold(450)
    assert released.out[-1] == (450, 'second')
    released.answer(2000, 'far')
    released.hold(1500)  # between two answers, near none
    assert released.out[-1] == (1500, None)


def test_items_keep_their_order():
    released = Released()
    for ms in (100, 200, 300):
        released.hold(ms)
    released.answer(200, 'no')
    assert [item for item, _ in released.out] == [100, 200]
    released.time(1400)
    assert [item for item, _ in released.out] == [100, 200, 300]


def test_stamps_that_start_again():
    released = Released()
    released.answer(50_000, 'old drive')
    released.hold(50_100)
    released.gate.clear()
    released.hold(100)
    assert released.out == []
    released.answer(50_200, 'a straggler of the old drive')
    assert released.out == [(100, None)]  # not older than the item, but far from it
    released.answer(200, 'no')
    released.hold(200)
    assert released.out[-1] == (200, 'no')


def test_no_more_wait_than_there_is_room():
    out = []
    gate = PlaceGate(PlaceGateConfig(use=True), lambda item, verdict: out.append(item), capacity=3)
    for number in range(5):
        gate.hold(number * MS, number)
    assert out == [0, 1]
    assert len(gate) == 3
