"""Search for poses from two point sets alone, with numpy and numba, without training.

Unless a docstring says otherwise, a pose is `rotation` (3, 3) and `translation` (3,), camera = R p + t; `bearings`
(m, 3) are unit vectors in the camera's frame, `points3d` (n, 3) scene points, `normals3d` (n, 3) outward unit normals,
`labels2d` (m,) and `labels3d` (n,) labels, of which -1 fits any. A `scale` is the standard deviation of the residuals
of a pose, and a `spread` the RMS angular radius of the bearings, both in radians. Lists of poses are in order, best
first. Buffers of compiled loops are overwritten. None stands for what is not given.
"""
