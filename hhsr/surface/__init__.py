"""Rebuild the surface of a tree as one closed mesh (PAPER Algorithm 2)."""
