"""Train teachers, students and their rivals on runs of submaps.

Once the runs are made only torch, numpy, scipy and safetensors are needed; tqdm shows progress and
matplotlib draws curves where they are installed.
"""
