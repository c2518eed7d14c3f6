"""Sparse 3D convolution in pure torch, for point clouds in voxels: CPU and GPU, with gradients."""

from lcd_common.sparse.convolution import InverseConv3d, SparseConv3d, SubmanifoldConv3d
from lcd_common.sparse.kernel_map import KernelMap
from lcd_common.sparse.tensor import SparseTensor, voxelize

__all__ = [
    'InverseConv3d',
    'KernelMap',
    'SparseConv3d',
    'SparseTensor',
    'SubmanifoldConv3d',
    'voxelize',
]
