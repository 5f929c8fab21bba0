"""How long a unit of a rigid run's map is: measured by what is known of the scene."""
