"""Install lcd_loop_closure: colcon and pip both read this file."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'lcd_loop_closure'

setup(
    name=NAME,
    version='0.1.0',
    description='LiDAR odometry, loop closure and pose graph',
    author='the authors of the localization suite',
    maintainer='the authors of the localization suite',
    maintainer_email='maintainers@example.com',
    license='MIT',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', '**/*.html', '**/*.json', '**/*.safetensors']},
    python_requires='>=3.11',
    # requirements/ pins everything; the suite's own packages are named in package.xml alone,
    # because pip would look for packages of these names elsewhere.
    install_requires=[
        'evo',
        'fpsample',
        'gtsam',
        'jinja2',
        'kiss-icp',
        'matplotlib',
        'numpy',
        'open3d',
        'safetensors',
        'scipy',
        'small-gicp',
        'torch',
        'tqdm',
    ],
    extras_require={'test': ['pytest']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*.yaml'))),
    ],
    entry_points={
        'console_scripts': [
            'lidar_odometry = lcd_loop_closure.nodes.lidar_odometry_node:main',
            'loop_closure = lcd_loop_closure.nodes.loop_closure_node:main',
            'pose_graph = lcd_loop_closure.nodes.pose_graph_node:main',
            'run_drive = lcd_loop_closure.report.run_drive:main',
            'loop_statistics = lcd_loop_closure.report.loop_statistics:main',
            'train_lcdnet = lcd_loop_closure.lcdnet.train:main',
            'train_lcdnet_place_head = lcd_loop_closure.lcdnet.train_place_head:main',
            'evaluate_loops = lcd_loop_closure.evaluation.evaluate_loops:main',
        ],
    },
    zip_safe=False,
)
