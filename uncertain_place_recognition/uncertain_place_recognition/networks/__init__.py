"""Networks that turn submaps into embeddings; each with its original and a compact shape."""

from uncertain_place_recognition.networks.bev_netvlad import BevNetVlad, BevNetVladConfig
from uncertain_place_recognition.networks.embedding import Embedding, PlaceNetwork
from uncertain_place_recognition.networks.minkloc3d import MinkLoc3d, MinkLoc3dConfig
from uncertain_place_recognition.networks.pointnetvlad import PointNetVlad, PointNetVladConfig

__all__ = [
    'BevNetVlad',
    'BevNetVladConfig',
    'Embedding',
    'MinkLoc3d',
    'MinkLoc3dConfig',
    'PlaceNetwork',
    'PointNetVlad',
    'PointNetVladConfig',
]
