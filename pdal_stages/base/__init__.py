"""What all other packages build on: errors, checks, files, LAS headers, threads, messages, units."""
