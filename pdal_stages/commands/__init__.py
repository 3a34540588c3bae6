"""What ``pdal-stages`` can do: a module for each group of commands, with their arguments and what they do."""
