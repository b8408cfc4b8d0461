"""Random scenes, photos of them and the sparse maps that such photos give: pairs without a download."""
