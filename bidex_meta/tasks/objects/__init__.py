"""Objects chosen by config, from files in the package or of users; each is checked, and may be laid on a hand."""
