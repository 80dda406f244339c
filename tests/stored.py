"""A server of objects for tests of dumps and catalogues in a store."""

import contextlib
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest


@contextlib.contextmanager
def bucket_served() -> Iterator[tuple[str, Any]]:
    """The address of a server with one empty bucket, `archive`, and a file system that writes into it files
    that all may read, over HTTP too. Credentials are in the environment as long as it serves.
    """
    import fsspec
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    address = "http://{}:{}".format(*server.get_host_and_port())
    # All servers of a process have the same buckets, those of an earlier one too.
    urllib.request.urlopen(urllib.request.Request(f"{address}/moto-api/reset", method="POST")).close()
    environment = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_ENDPOINT_URL": address}
    environment |= {"AWS_DEFAULT_REGION": "us-east-1", "AWS_EC2_METADATA_DISABLED": "true"}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        fsspec.get_filesystem_class("s3").clear_instance_cache()  # an earlier server
        files = fsspec.filesystem("s3", skip_instance_cache=True, s3_additional_kwargs={"ACL": "public-read"})
        files.mkdir("archive")
        yield address, files
    server.stop()
