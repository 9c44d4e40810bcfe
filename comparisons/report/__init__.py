"""What a comparison found: rows, summary, sentences, tables, pictures, a page."""
