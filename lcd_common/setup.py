"""Install lcd_common: colcon and pip both read this file."""

from setuptools import find_packages, setup

NAME = 'lcd_common'

setup(
    name=NAME,
    version='0.1.0',
    description='SE(3), clouds, settings, trajectories and ROS plumbing of the localization suite',
    author='the authors of the localization suite',
    maintainer='the authors of the localization suite',
    maintainer_email='maintainers@example.com',
    license='MIT',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', '**/*.html', '**/*.json', '**/*.xml']},
    python_requires='>=3.11',
    # requirements/ pins everything; the suite's own packages are named in package.xml alone,
    # because pip would look for packages of these names elsewhere.
    install_requires=['numpy', 'safetensors', 'scipy', 'torch'],
    extras_require={'test': ['pytest']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', [f'{NAME}/fast_dds.xml']),
    ],
    entry_points={
        'console_scripts': [],
    },
    zip_safe=False,
)
