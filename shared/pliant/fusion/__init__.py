"""The TSDF volume on Open3D's blocks: the only room that imports open3d."""
