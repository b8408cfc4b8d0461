"""Random scenes, photos of them and the sparse maps that such photos give: problems without a download."""
