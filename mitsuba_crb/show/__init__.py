"""What a person looks at: terminal tables, plots, pages of pictures. Only the command imports it."""
