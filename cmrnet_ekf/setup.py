"""Install cmrnet_ekf: colcon and pip both read this file."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'cmrnet_ekf'

setup(
    name=NAME,
    version='0.1.0',
    description='Camera to LiDAR map with uncertainty, and the EKF that fuses it',
    author='the authors of the localization suite',
    maintainer='the authors of the localization suite',
    maintainer_email='maintainers@example.com',
    license='MIT',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', '**/*.json', '**/*.safetensors']},
    python_requires='>=3.11',
    # requirements/ pins everything; the suite's own packages are named in package.xml alone,
    # because pip would look for packages of these names elsewhere.
    install_requires=[
        'filterpy',
        'matplotlib',
        'numba',
        'numpy',
        'safetensors',
        'scipy',
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
            'ekf = cmrnet_ekf.nodes.ekf_node:main',
            'map_registration = cmrnet_ekf.nodes.map_registration_node:main',
            'build_lidar_map = cmrnet_ekf.mapping.build:main',
            'make_cmrnet_samples = cmrnet_ekf.training.make:main',
            'train_cmrnet = cmrnet_ekf.training.train:main',
            'evaluate_cmrnet = cmrnet_ekf.evaluation.evaluate:main',
            'track_cmrnet = cmrnet_ekf.evaluation.track:main',
        ],
    },
    zip_safe=False,
)
