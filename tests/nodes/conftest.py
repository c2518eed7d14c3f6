"""Let the tests of this folder import its helpers, and clean up their nodes."""

import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

sys.path.append(str(Path(__file__).parent))


@pytest.fixture
def make(ros: None) -> Iterator[Callable[..., Any]]:
    """Make nodes that are destroyed when the test ends: `make(PoseGraphNode, threaded=False)`."""
    from lcd_common.nodes.parameters import overrides

    nodes: list[Any] = []

    def construct(
        cls: Any,
        namespace: str | None = None,
        cli_args: list[str] | None = None,
        **parameters: object,
    ) -> Any:
        node = cls(
            namespace=namespace, cli_args=cli_args, parameter_overrides=overrides(**parameters)
        )
        nodes.append(node)
        return node

    yield construct
    for node in nodes:
        node.destroy_node()


@pytest.fixture
def make_often(make: Callable[..., Any]) -> Callable[..., Any]:
    """Make nodes with more keyframes than by default: the made-up drive is short."""
    return partial(make, keyframes__distance=2.0)
