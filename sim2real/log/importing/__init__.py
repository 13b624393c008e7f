"""Files of other recorders as logs: the mapping of signals to joints, its evidence, and the importer."""
