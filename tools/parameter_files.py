"""Write the nodes' parameter files from the settings that the nodes declare.

    python tools/parameter_files.py          writes config/*.yaml of the packages
                                             and the tables of their README.md
    python tools/parameter_files.py --check  says which of them are out of date

A setting's default, meaning and unit stand in the code alone; this keeps the files true to it.
"""

import argparse
import ast
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cmrnet_ekf.ekf.ekf_settings import EkfSettings
from cmrnet_ekf.ekf.gnss_start import GnssStartConfig
from cmrnet_ekf.mapping.local_map import LocalMapConfig
from cmrnet_ekf.nodes.ekf_health import EkfHealthConfig
from cmrnet_ekf.nodes.ekf_inputs import FixInputConfig, OdometryInputConfig, PoseInputConfig
from cmrnet_ekf.nodes.ekf_node import EkfNodeConfig
from cmrnet_ekf.nodes.ekf_sources import EkfInputsConfig
from cmrnet_ekf.nodes.gnss_datum import GnssDatumConfig
from cmrnet_ekf.nodes.map_registration_node import MapRegistrationConfig
from lcd_common.settings import describe
from lcd_loop_closure.graph_settings import GraphSettings
from lcd_loop_closure.imu_preintegration import ImuConfig
from lcd_loop_closure.keyframes import KeyframeConfig
from lcd_loop_closure.lidar_odometry import OdometryConfig
from lcd_loop_closure.loop_detector import LoopDetectorSettings
from lcd_loop_closure.map_cloud import MapCloudConfig
from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNodeConfig
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNodeConfig
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNodeConfig
from lcd_loop_closure.online_map import OnlineMapConfig
from lcd_loop_closure.place_gate import PlaceGateConfig
from lcd_loop_closure.reduction import ReductionConfig
from lcd_loop_closure.robust_solver import RobustSolverConfig
from lcd_loop_closure.session_anchor import AnchorConfig
from uncertain_place_recognition.drive_places import AskedConfig, PlaceSpacingConfig
from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNodeConfig
from uncertain_place_recognition.place_recognizer import PlaceRecognizerConfig
from uncertain_place_recognition.relocalizer import RelocalizerConfig
from uncertain_place_recognition.retrieval.engines import IndexConfig
from uncertain_place_recognition.retrieval.faiss_index import FaissConfig
from uncertain_place_recognition.retrieval.qdrant_index import QdrantConfig

ROOT = Path(__file__).resolve().parents[1]
_COMMENT_AT = 44
_Parts = tuple[tuple[type, ...], dict[str, type]]


def parameter_files() -> dict[Path, str]:
    """Return every parameter file's path and what it must hold, and the READMEs'."""
    files: dict[Path, str] = {}
    for package, nodes in _nodes().items():
        config, readme = ROOT / package / 'config', ROOT / package / 'README.md'
        files |= {config / f'{node}.yaml': _file(node, *parts) for node, parts in nodes.items()}
        files[readme] = _readme(readme, nodes)
    return files


def _nodes() -> dict[str, dict[str, _Parts]]:
    """Return each package's nodes and their settings: those without a prefix, and the groups."""
    return {
        'cmrnet_ekf': {
            'ekf': (
                (EkfNodeConfig, EkfInputsConfig),
                {
                    **_groups(EkfSettings()),
                    'camera': PoseInputConfig,
                    'odom': OdometryInputConfig,
                    'gps': FixInputConfig,
                    'datum': GnssDatumConfig,
                    'gnss_start': GnssStartConfig,
                    'health': EkfHealthConfig,
                },
            ),
            'map_registration': ((MapRegistrationConfig,), {'local_map': LocalMapConfig}),
        },
        'lcd_loop_closure': {
            'lidar_odometry': ((LidarOdometryNodeConfig, OdometryConfig), {}),
            'loop_closure': (
                (LoopClosureNodeConfig,),
                {
                    'keyframes': KeyframeConfig,
                    'gate': PlaceGateConfig,
                    **_groups(LoopDetectorSettings()),
                },
            ),
            'pose_graph': (
                (PoseGraphNodeConfig,),
                {
                    **_groups(GraphSettings()),
                    'imu': ImuConfig,
                    'solver': RobustSolverConfig,
                    'online_map': OnlineMapConfig,
                    'anchor': AnchorConfig,
                    'map_cloud': MapCloudConfig,
                },
            ),
        },
        'uncertain_place_recognition': {
            'place_recognition': (
                (PlaceRecognitionNodeConfig,),
                {
                    'asked': AskedConfig,
                    'places': PlaceSpacingConfig,
                    'recognizer': PlaceRecognizerConfig,
                    'index': IndexConfig,
                    'index.faiss': FaissConfig,
                    'index.qdrant': QdrantConfig,
                    'reduction': ReductionConfig,
                    'relocalizer': RelocalizerConfig,
                },
            ),
        },
    }


def _groups(settings: Any) -> dict[str, type]:
    return {f.name: type(getattr(settings, f.name)) for f in dataclasses.fields(settings)}


def _readme(readme: Path, nodes: dict[str, _Parts]) -> str:
    """Return the README with the parameters between its markers."""
    text = readme.read_text()
    for node, (tops, groups) in nodes.items():
        begin = f'<!-- parameters:{node} -->'
        before, found, rest = text.partition(begin)
        if not found or '<!-- end -->' not in rest:
            raise SystemExit(f'error: {readme} has no {begin} ... <!-- end -->')
        table = [
            '',
            '',
            '| parameter | default | unit | range | meaning |',
            '|---|---|---|---|---|',
        ]
        for prefix, cls in [*(('', top) for top in tops), *((f'{g}.', groups[g]) for g in groups)]:
            table += [_table_row(prefix, *row) for row in describe(cls)]
        text = before + begin + '\n'.join(table) + '\n\n' + rest[rest.index('<!-- end -->') :]
    return text


def _table_row(prefix: str, name: str, default: str, unit: str, bounds: str, meaning: str) -> str:
    value = _yaml(ast.literal_eval(default))
    allowed = ', '.join(bounds.split(' | '))
    return f'| `{prefix}{name}` | `{value}` | {unit} | {allowed} | {meaning} |'


def _file(node: str, tops: tuple[type, ...], groups: dict[str, type]) -> str:
    lines = [
        f'# Parameters of {node} with their defaults; keep the lines that you change.',
        '# Written by tools/parameter_files.py.',
        f'/**/{node}:',
        '  ros__parameters:',
        *(row for top in tops for row in _rows(top, '    ')),
    ]
    for name, cls in groups.items():
        meaning = (cls.__doc__ or '').strip().splitlines()[0]
        lines += ['', f'    # {meaning}', f'    {name}:', *_rows(cls, '      ')]
    return '\n'.join(lines) + '\n'


def _rows(cls: type, indent: str) -> list[str]:
    return [
        f'{indent}{name}: {_yaml(ast.literal_eval(default))}'.ljust(_COMMENT_AT)
        + f'  # {description}'
        + (f' [{unit}]' if unit else '')
        + (f': {bounds}' if '|' in bounds else '')
        for name, default, unit, bounds, description in describe(cls)
    ]


def _yaml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    text = repr(value)
    # YAML 1.1 reads 1e-05 as a word: a number needs its point.
    return text.replace('e', '.0e') if 'e-' in text and '.' not in text else text


def main(argv: Sequence[str] | None = None) -> int:
    """Write the files, or with --check compare them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--check', action='store_true', help='only say what is out of date')
    check = parser.parse_args(argv).check
    stale = [p for p, text in parameter_files().items() if not p.exists() or p.read_text() != text]
    for path in stale:
        if check:
            sys.stdout.write(f'{path.name} is out of date: run python tools/parameter_files.py\n')
        else:
            path.write_text(parameter_files()[path])
            sys.stdout.write(f'wrote {path}\n')
    return int(check and bool(stale))


if __name__ == '__main__':
    sys.exit(main())
