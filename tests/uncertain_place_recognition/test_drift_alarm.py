import numpy as np
import pytest

from lcd_common.errors import DataError, MapError
from uncertain_place_recognition.drift_alarm import DriftAlarm, DriftConfig, DriftReference


@pytest.fixture
def reference():
    rng = np.random.default_rng(0)
    return DriftReference.fit([rng.gamma(4.0, 1.0, 500) for _ in range(6)], block=5)


def test_blocks_do_not_reach_over_the_end_of_a_run():
    reference = DriftReference.fit([[1.0, 2.0, 9.0], [4.0, 6.0]], block=2)
    assert reference.means.tolist() == [1.5, 5.0]


def test_p_values_by_their_definition(reference):
    for mean in (0.0, 3.0, 4.0, 8.0, reference.means[17]):
        as_high = np.sum(reference.means >= mean)
        assert reference.p_value(mean) == (as_high + 1) / (len(reference.means) + 1)
    assert reference.p_value(np.inf) == reference.p_value(np.nan) == 1 / 601


def test_p_values_agree_with_crepes():
    from crepes.base import p_values_batch

    rng = np.random.default_rng(1)
    calibration, test = rng.normal(size=99), rng.normal(size=20)
    expected = p_values_batch(calibration, test, smoothing=False)
    reference = DriftReference.fit([calibration], block=1)
    assert [reference.p_value(value) for value in test] == pytest.approx(expected.ravel())


def test_evidence_is_that_of_crepes_while_it_stays_above_its_start():
    from crepes.martingales import SimpleJumper

    class PowerBets:
        E = np.array([0.1, 0.3, 0.6, 1.0])

        def apply(self, p_values):
            return np.array([[k * p ** (k - 1.0) for k in self.E] for p in p_values])

    reference = DriftReference(np.arange(999.0), 1)
    alarm = DriftAlarm(reference, DriftConfig(limit=1e12))
    rng = np.random.default_rng(2)
    means = rng.uniform(940, 998, 12)
    evidence = [alarm.update(mean).evidence for mean in means]
    p_values = np.array([reference.p_value(mean) for mean in means])
    jumper = SimpleJumper(J=0.01, bf=PowerBets())
    assert min(evidence) >= 1.0
    assert evidence == pytest.approx(jumper.apply(p_values), rel=1e-9)


def test_false_alarms_are_as_rare_as_promised(reference):
    rng = np.random.default_rng(3)
    settings = DriftConfig(limit=100.0)
    alarm, blocks, alarms = DriftAlarm(reference, settings), 0, 0
    for _ in range(60_000):
        if alarm.update(rng.gamma(4.0, 1.0)).alarm:
            alarms += 1
            alarm.reset()
    blocks = 60_000 / reference.block
    assert alarms <= blocks / settings.limit


def test_a_foreign_town_raises_the_alarm_soon_and_the_way_home_ends_it(reference):
    rng = np.random.default_rng(4)
    alarm = DriftAlarm(reference)
    for _ in range(2000):
        alarm.update(rng.gamma(4.0, 1.0))
    alarm.reset()
    shifted = [alarm.update(2.0 * rng.gamma(4.0, 1.0)).alarm for _ in range(100)]
    assert shifted[-1] and np.argmax(shifted) < 40
    home = [alarm.update(rng.gamma(4.0, 1.0)).alarm for _ in range(400)]
    assert home[0] and not home[-1]


def test_a_long_good_drive_does_not_delay_the_alarm(reference):
    rng = np.random.default_rng(5)
    fresh, driven = DriftAlarm(reference), DriftAlarm(reference)
    for _ in range(5000):
        driven.update(1.0)
    high = 2.5 * rng.gamma(4.0, 1.0, 100)
    first = [int(np.argmax([alarm.update(u).alarm for u in high])) for alarm in (fresh, driven)]
    assert first[0] == first[1] > 0


def test_nothing_is_said_before_a_block_is_whole(reference):
    alarm = DriftAlarm(reference)
    for _ in range(4):
        assert alarm.update(100.0).p_value is None
    assert alarm.update(100.0).p_value == pytest.approx(1 / 601)


def test_a_reference_survives_its_file_and_stays_small(reference):
    again = DriftReference.from_plain(reference.plain())
    assert np.array_equal(again.means, reference.means)
    many = DriftReference.fit([np.random.default_rng(6).normal(size=50_000)], block=1)
    assert len(many.means) == 1000
    assert np.median(many.means) == pytest.approx(0.0, abs=0.02)


def test_mistakes_are_named():
    with pytest.raises(DataError, match='5 queries'):
        DriftReference.fit([[1.0, 2.0]])
    with pytest.raises(MapError, match='no reference'):
        DriftReference.from_plain({'block': 3})
