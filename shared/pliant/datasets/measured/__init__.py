"""What other sensors of a source measured: inertial samples and satellite fixes."""
