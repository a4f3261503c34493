"""`make pictures`: those of the documents, made anew from real runs."""
