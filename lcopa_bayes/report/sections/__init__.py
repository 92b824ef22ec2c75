"""One module per section of the report; each turns a saved run into a `Section`."""
