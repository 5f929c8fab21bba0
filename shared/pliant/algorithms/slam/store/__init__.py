"""Maps that are kept: earlier segments and earlier sessions."""
