"""Which of several models of the same records is warranted."""
