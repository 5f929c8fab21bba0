"""Other sensors of a source: inertial samples and satellite fixes."""
