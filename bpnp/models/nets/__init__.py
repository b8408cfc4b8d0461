"""The neural networks that give points their features."""

from bpnp.models.nets.features import ImageFeatures, PointFeatures, SceneFeatures

__all__ = ["ImageFeatures", "PointFeatures", "SceneFeatures"]
