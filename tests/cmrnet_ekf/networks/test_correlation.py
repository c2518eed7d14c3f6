import pytest
import torch

from cmrnet_ekf.networks.correlation import correlate


@pytest.mark.parametrize(('size', 'd'), [((6, 20), 4), ((3, 2), 4), ((5, 7), 1)])
def test_each_displacement_is_the_mean_product_over_channels(size, d):
    torch.manual_seed(0)
    one, other = torch.randn(2, 5, *size), torch.randn(2, 5, *size)
    found = correlate(one, other, d)
    assert found.shape == (2, (2 * d + 1) ** 2, *size)
    expected = torch.zeros_like(found)
    channel = 0
    for down in range(-d, d + 1):
        for right in range(-d, d + 1):
            for v in range(size[0]):
                for u in range(size[1]):
                    if 0 <= v + down < size[0] and 0 <= u + right < size[1]:
                        product = one[:, :, v, u] * other[:, :, v + down, u + right]
                        expected[:, channel, v, u] = product.mean(1)
            channel += 1
    torch.testing.assert_close(found, expected)


def test_its_gradient_is_right():
    torch.manual_seed(1)
    maps = [torch.randn(1, 2, 3, 4, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    assert torch.autograd.gradcheck(lambda a, b: correlate(a, b, 2), maps)
