"""What kernels do with grey levels: smaller images, and small patches that are aligned."""
