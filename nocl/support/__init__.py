"""What knows nothing of control: checks of input, data-only files, processes, compilers, threads, Ctrl-C."""
