"""Reads a merged run without anything of this project or of the library that wrote it.

    python reader_partner.py RUN.mcap

Each message is held against the schema that is in the file: JSON by jsonschema-rs, protobuf by the
descriptors of its schema. Prints what was read, by schema, as JSON.
"""

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import jsonschema_rs
import small_mcap
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory


def protobuf_class(schema: Any) -> Any:
    """The class of the messages that a schema describes."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(bytes(schema.data)).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def main(path: Path) -> None:
    readers: dict[int, Any] = {}
    counts, topics = Counter[str](), Counter[str]()
    covariances = 0
    with path.open("rb") as file:
        for schema, channel, message in small_mcap.read_message(file, validate_crc=True):
            assert schema is not None, f"{channel.topic} has no schema"
            counts[schema.name] += 1
            topics[channel.topic] += 1
            data = bytes(message.data)
            if schema.encoding == "jsonschema":
                if schema.id not in readers:
                    readers[schema.id] = jsonschema_rs.validator_for(json.loads(bytes(schema.data)))
                readers[schema.id].validate(json.loads(data))
                continue
            if schema.id not in readers:
                readers[schema.id] = protobuf_class(schema)
            read = readers[schema.id].FromString(data)
            assert read.SerializeToString() == data, f"{channel.topic} is not whole"
            covariances += len(getattr(read, "pose_covariance", ())) == 36
    with path.open("rb") as file:
        header = small_mcap.get_header(file)
    about = {"schemas": counts, "topics": topics, "covariances": covariances}
    sys.stdout.write(json.dumps({**about, "profile": header.profile}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
