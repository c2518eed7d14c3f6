"""Install uncertain_place_recognition: colcon and pip both read this file."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'uncertain_place_recognition'

setup(
    name=NAME,
    version='0.1.0',
    description='Place recognition that knows when not to be believed',
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
        'matplotlib',
        'numpy',
        'safetensors',
        'scipy',
        'torch',
        'tqdm',
    ],
    extras_require={
        'faiss': ['faiss-cpu'],
        'qdrant': ['qdrant-client'],
        'test': ['pytest'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*.yaml'))),
    ],
    entry_points={
        'console_scripts': [
            'place_recognition = uncertain_place_recognition.nodes.place_recognition_node:main',
            'make_submap_runs = uncertain_place_recognition.datasets.make_runs:main',
            'calibrate_place_recognition = uncertain_place_recognition.calibrate:main',
            'evaluate_place_recognition = uncertain_place_recognition.evaluate:main',
            'train_place_recognition = uncertain_place_recognition.training.train:main',
        ],
    },
    zip_safe=False,
)
