"""``--view``: a viewer beside a stage shows the files that the stage writes."""
