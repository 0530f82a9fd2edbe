"""Transport of bytes, independent of any protocol."""
