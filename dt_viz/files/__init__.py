"""Files: checks, archives of arrays, and visitors' files, which a process with limits reads."""
