"""Objects that a config chooses, from files of the package or of users; each is checked and may be laid on a hand."""
