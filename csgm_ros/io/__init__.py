"""Files, bags, PointCloud2 layouts, configuration files and results."""
