"""Map of an object, fused from the patterns of a pad that slides over it or touches it again and again."""
