"""What every room stands on: errors, checks, files, LAS headers, threads, messages, units."""
