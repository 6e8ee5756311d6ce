"""Shards: tar files of shapes, written once and read at random."""

from lsmgeo.data.shards.write_shards import hash_settings, verify_shard, write_shard

__all__ = ["hash_settings", "verify_shard", "write_shard"]
