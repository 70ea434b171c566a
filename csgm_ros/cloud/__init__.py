"""What any step needs of a cloud: preparation, voxels, normals, nearest points, outliers, smoothing."""
