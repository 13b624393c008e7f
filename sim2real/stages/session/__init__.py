"""The stage record; excitations, and the episodes of record and deploy on an open robot."""
