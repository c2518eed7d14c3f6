"""What the tables about LCDNet's rivals and variants show of benchmarks/results/lcdnet.json."""

from benchmarks.result_table import Cell, Table, WideRow

_BANDS = ('0_4', '4_10', '10_15')
_REGISTRATIONS = {
    'lcdnet': 'LCDNet as the node runs it (features, refinement)',
    'lcdnet_ransac': 'LCDNet (features, RANSAC)',
    'lcdnet_gnc': 'LCDNet + GNC-TLS',
    'lcdnet_kiss_matcher': "LCDNet + KISS-Matcher's solver",
    'lcdnet_icp': 'LCDNet + ICP',
    'lcdnet_fast': 'LCDNet (fast: transport alone)',
    'kiss_matcher': 'KISS-Matcher',
    'kiss_matcher_gicp': 'KISS-Matcher + GICP',
    'fpfh_ransac': 'FPFH + RANSAC',
    'fgr': 'FGR',
    'small_gicp': 'small_gicp',
    'icp_point_to_point': 'ICP, point to point',
    'icp_point_to_plane': 'ICP, point to plane',
}
# The thesis's own figures (Tables 3.8 and 3.9, KITTI 08, full size, 150 epochs) stand beside.
_VARIANTS = {
    'lcdnet': ('the compact one: PV-RCNN, UOT, D = 128, N = 1024', '0.92, 1.85 m, 3.19° (D = 128)'),
    'backbone_pointnet': ('backbone PointNet', '0.67, 5.15 m, 34.14°'),
    'backbone_edgeconv': ('backbone EdgeConv', '0.52, 5.44 m, 16.85°'),
    'backbone_randla': ('backbone RandLA-Net', '0.55, 3.55 m, 20.08°'),
    'head_mlp_sincos': ('pose head MLP (sin-cos)', '0.75, 2.14 m, 21.05°'),
    'head_mlp_quaternion': ('pose head MLP (quaternion)', '0.78, 2.43 m, 35.16°'),
    'head_mlp_bingham': ('pose head MLP (Bingham)', '0.75, 2.27 m, 22.69°'),
    'd_640': ('D = 640', '0.94, 1.62 m, 3.13°'),
    'd_64': ('D = 64', '0.92, 1.99 m, 3.33°'),
    'd_32': ('D = 32', '0.86, 2.23 m, 4.09°'),
    'no_transport_loss': ('without the auxiliary loss', '0.83, 6.00 m, 4.71°'),
    'n_512': ('N = 512', '0.50, 4.79 m, 4.85°'),
    'n_2048': ('N = 2048', '0.85, 4.68 m, 3.73°'),
    'n_4096': ('N = 4096', '0.94, 1.62 m, 3.13°'),
}


def _registration(method: str, what: str) -> WideRow:
    near = f'registration.{_BANDS[0]}'
    return WideRow(
        what,
        (
            *(Cell('{:.1f} %', (f'registration.{band}.success.{method}',), 100) for band in _BANDS),
            Cell('{:.3f} m, {:.2f}°', (f'{near}.te_m.{method}', f'{near}.re_deg.{method}')),
            Cell('{:.0f} ms', (f'{near}.register_ms.{method}',)),
            Cell('{:.0f}', (f'{near}.pairs.{method}',)),
        ),
    )


def _variant(name: str, what: str, thesis: str) -> WideRow:
    figures = f'ablations.{name}'
    return WideRow(
        what,
        (
            Cell('{:.2f}', (f'{figures}.average_precision',)),
            Cell('{:.0f} %', (f'{figures}.loops_success',), 100),
            Cell('{:.2f} m, {:.1f}°', (f'{figures}.pose_te_m', f'{figures}.pose_re_deg')),
            thesis,
        ),
    )


LCDNET_TABLES = {
    'lcdnet_registration': Table(
        'lcdnet',
        tuple(_registration(method, what) for method, what in _REGISTRATIONS.items()),
        (
            'within 2 m and 5°', '0-4 m', '4-10 m', '10-15 m', 'errors of successes, 0-4 m',
            'a pair', 'pairs a band',
        ),
        section='registration',
    ),
    'lcdnet_ablations': Table(
        'lcdnet',
        tuple(_variant(name, what, thesis) for name, (what, thesis) in _VARIANTS.items()),
        (
            'network', 'AP', 'loops registered by features', 'pose head, all loops: TE, RE',
            "the thesis's AP, TE, RE",
        ),
        section='ablations',
    ),
}  # fmt: skip
