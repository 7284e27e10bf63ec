"""Data sets on disk: Parquet shards with a manifest, made, merged and checked part by part."""
