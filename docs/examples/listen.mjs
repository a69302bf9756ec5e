// Print every contact that touchd sees. Once: npm install zeromq
// The default address is the service's; a touchd started by hand publishes at tcp://127.0.0.1:5570.
import { Subscriber } from "zeromq";

const socket = new Subscriber();
socket.connect(process.argv[2] ?? "ipc:///run/touchd/bus");
socket.subscribe("touch");

let last = {};
for await (const [, payload] of socket) {
  const event = JSON.parse(payload.toString());
  if (event.seq === last.seq && event.t_ns === last.t_ns) continue; // sent once more for another subscriber's sake
  last = event;
  for (const c of event.contacts) console.log(c.id, c.phase, c.x_mm.toFixed(1), c.y_mm.toFixed(1));
}
