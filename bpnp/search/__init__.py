"""Search for poses from two point sets alone, with numpy and numba, without training.

Unless a docstring says otherwise, a pose is `rotation` (3, 3) and `translation` (3,), camera = R p + t; `bearings` (m,
3) are unit vectors in the camera's frame, `points3d` (n, 3) scene points, `normals3d` (n, 3) outward unit normals,
`labels2d` (m,) and `labels3d` (n,) labels, of which -1 fits any; `scale` is the standard deviation of the residuals of
a pose, radians; and None stands for what is not given.
"""
