"""Warp ops for torch tensors: rays, neighbours, and the fused blend of the Implicit LiDAR Network."""
