"""The neural networks that give points their features."""
