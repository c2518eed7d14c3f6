"""Registration by LCDNet's features, with features that are made so that the answer is known."""

import numpy as np
import pytest
import torch
from evaluation_samples import World, out_and_back, tiny_network, tiny_weights

from lcd_common import se3
from lcd_common.errors import ConfigError
from lcd_loop_closure.evaluation.lcdnet_registration import (
    LcdnetFast,
    LcdnetGnc,
    LcdnetKissMatcher,
    LcdnetRansac,
    NodeRegistration,
)
from lcd_loop_closure.evaluation.methods import DESCRIPTORS, REGISTRATIONS, Methods
from lcd_loop_closure.lcdnet_descriptor import LcdnetDescriptor
from lcd_loop_closure.lcdnet_settings import LcdnetDescriptorConfig
from lcd_loop_closure.local_features import LocalFeatures

T_MATCH_QUERY = se3.exp([3.0, -2.0, 0.2, 0.01, -0.02, 2.5])


@pytest.fixture(scope='module')
def descriptor():
    network = tiny_network()
    with torch.no_grad():
        network.transport.log_lambda.fill_(-6.0)  # matches all but hard
    return LcdnetDescriptor(LcdnetDescriptorConfig(device='cpu'), network)


def pair() -> tuple[LocalFeatures, LocalFeatures]:
    """Return the same keypoints in the frames of a match and a query, in another order."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-30, -30, 0], [30, 30, 6], (96, 3))
    values = rng.normal(size=(96, 24)).astype(np.float16)
    order = rng.permutation(96)
    in_match = se3.transform_points(T_MATCH_QUERY, xyz)[order]
    return (
        LocalFeatures(in_match.astype(np.float32), values[order]),
        LocalFeatures(xyz.astype(np.float32), values),
    )


@pytest.mark.parametrize('kind', [LcdnetFast, LcdnetRansac, LcdnetGnc, LcdnetKissMatcher])
def test_matched_keypoints_give_the_pose_of_the_query_in_the_match(descriptor, kind):
    if kind is LcdnetKissMatcher:
        pytest.importorskip('kiss_matcher', reason='kiss-matcher is not installed')
    match, query = pair()
    T = kind(descriptor).register(match, query)
    metres, radians = se3.distance(T_MATCH_QUERY, T)
    assert metres < 0.02 and radians < 1e-3


def test_the_node_registers_a_cloud_with_itself_and_accepts_it(descriptor):
    world = World(out_and_back(15.0))
    registration = NodeRegistration(descriptor)
    match, query = (registration.prepare(world.cloud(2)) for _ in range(2))
    result = registration.judge(match, query)
    assert result.status.name == 'ACCEPTED'
    assert se3.distance(np.eye(4), registration.register(match, query))[0] < 0.01


def test_what_is_not_accepted_is_no_answer_where_that_is_asked(descriptor):
    here = World(out_and_back(15.0), seed=0).cloud(2)
    elsewhere = World(out_and_back(15.0), seed=7).cloud(2)
    registration = NodeRegistration(descriptor, accepted_only=True)
    assert registration.name == 'lcdnet_accepted'
    a, b = registration.prepare(here), registration.prepare(elsewhere)
    assert registration.judge(a, b).status.name != 'ACCEPTED'
    assert registration.register(a, b) is None
    assert registration.register(a, a) is not None


def test_every_name_can_be_built(tmp_path):
    methods = Methods(tiny_weights(tmp_path), device='cpu')
    keys = {methods.descriptor(name).key for name in DESCRIPTORS}
    assert len(keys) == len(DESCRIPTORS)
    for name in REGISTRATIONS:
        if 'kiss' in name:
            pytest.importorskip('kiss_matcher', reason='kiss-matcher is not installed')
        assert callable(methods.registration(name).register)
    with pytest.raises(ConfigError, match='no method'):
        methods.descriptor('gps')
    with pytest.raises(ConfigError, match='no registration'):
        methods.registration('by eye')


def test_other_weights_have_other_keys(tmp_path):
    from lcd_loop_closure.lcdnet.checkpoint import save_network

    first = tiny_weights(tmp_path)
    second = tmp_path / 'other.safetensors'
    save_network(second, tiny_network(1), {})
    keys = {Methods(path, device='cpu').descriptor('lcdnet').key for path in (first, second)}
    assert len(keys) == 2
