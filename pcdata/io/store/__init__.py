"""Built data sets: records, where they live, and what the manifest says of them."""
