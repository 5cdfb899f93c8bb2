"""Runs with dora-rs, which speaks rmw_zenoh in Rust: it sends back whatever it hears.

    python dora_partner.py COMPATIBILITY CONFIG TOPIC=PACKAGE/TYPE...

COMPATIBILITY is `humble` or `rep2016`, CONFIG a file with the configuration of a Zenoh session.
It reads each topic into Arrow, and publishes that on TOPIC_echo. The first message of each topic
is printed as JSON: `TOPIC MESSAGE`. It ends with its standard input. Without anything of this
project.
"""

import json
import sys
import threading
import time
import warnings

import dora


def main(compatibility: str, config: str, *topics: str) -> None:
    warnings.simplefilter("ignore")
    transport = dora.Ros2Transport.zenoh(compatibility, config)
    context = dora.Ros2Context(transport=transport)
    node = context.new_node("echo", "/dora", dora.Ros2NodeOptions(rosout=False))
    qos = dora.Ros2QosPolicies(reliable=True, keep_last=64, max_blocking_time=1.0)
    pairs = []
    for text in topics:
        topic, _, kind = text.partition("=")
        publisher = node.create_publisher(node.create_topic(f"/{topic}_echo", kind, qos))
        subscription = node.create_subscription(node.create_topic(f"/{topic}", kind, qos))
        pairs.append((topic, subscription, publisher))
    print("ready", flush=True)  # noqa: T201
    rest = threading.Thread(target=sys.stdin.read, daemon=True)
    rest.start()
    printed = set()
    while rest.is_alive():
        idle = True
        for topic, subscription, publisher in pairs:
            while (message := subscription.next()) is not None:
                idle = False
                publisher.publish(message)
                if topic not in printed:
                    printed.add(topic)
                    print(topic, json.dumps(message.to_pylist()), flush=True)  # noqa: T201
        if idle:
            time.sleep(0.001)


if __name__ == "__main__":
    main(*sys.argv[1:])
