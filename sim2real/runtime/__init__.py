"""Running a graph: on the wall clock, on a simulated clock, or compiled into one program."""
