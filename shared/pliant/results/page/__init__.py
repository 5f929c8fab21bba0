"""report.html: a run at a glance, one file for any browser, without a network."""
