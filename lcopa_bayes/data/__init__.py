"""Records, drives and studies, read and checked."""
