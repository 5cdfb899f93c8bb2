// A driver and a consumer in Node or a browser, over one WebSocket:
//   node --experimental-websocket gateway_client.mjs TOKEN [ROBOT [URL]]     (Node 20 or later)
const [token, robot = "r1", url = "ws://127.0.0.1:8447"] = process.argv.slice(2);
const now = () => Date.now() * 1e6; // nanoseconds

function connect() {
  const stream = new WebSocket(`${url}/stream/${robot}?token=${token}`);
  let last = now(), timer;
  stream.onopen = () => {
    console.error(`connected to ${url}`);
    timer = setInterval(() => {
      const stamp_ns = now();
      const odometry = { from_ns: last, stamp_ns, distance_m: 0.02, turn_rad: 0 };
      const door = { id: "door", range_m: 2.0, bearing_rad: 0.1 };
      stream.send(JSON.stringify({ odometry }));
      stream.send(JSON.stringify({ sightings: { stamp_ns, sightings: [door] } }));
      last = stamp_ns;
    }, 100);
  };
  stream.onmessage = ({ data }) => {
    const { pose, error } = JSON.parse(data);
    if (error) console.error(error);
    else console.log(pose.x_m, pose.y_m, pose.heading_rad, pose.lost);
  };
  const again = () => { // the gateway or the network may come back
    clearInterval(timer);
    stream.onerror = stream.onclose = null;
    setTimeout(connect, 1000);
  };
  stream.onclose = again;
  stream.onerror = () => { // not every program says `close` where there was no connection
    console.error(`no gateway at ${url}, or a wrong token`);
    again();
  };
}
connect();
