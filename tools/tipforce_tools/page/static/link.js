// The WebSocket to the server: requests with their responses, a stream, and reconnection.
const RETRY_MS = 1000;
const NO_CONNECTION = "no connection to the server";

export class Link {
  // take(id, answer) receives the pictures of a stream; opened() and closed() are called for each connection.
  constructor(take, opened, closed) {
    Object.assign(this, { take, opened, closed, number: 0, waiting: new Map(), done: false });
    this.open();
  }

  open() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
    this.socket = socket;
    this.parts = [];
    socket.onopen = () => this.opened();
    socket.onmessage = ({ data }) => this.receive(data);
    socket.onclose = () => {
      for (const { reject } of this.waiting.values()) reject(new Error(NO_CONNECTION));
      this.waiting.clear();
      this.closed();
      if (!this.done) setTimeout(() => this.open(), RETRY_MS);
    };
  }

  receive(data) {
    if (data instanceof Blob) {
      this.parts.push(data);
      return;
    }
    const { id, answer, error } = JSON.parse(data), waiting = this.waiting.get(id);
    if (!waiting) {
      if (answer) this.take(id, answer);
      return;
    }
    this.waiting.delete(id);
    if (error === undefined) waiting.resolve(answer);
    else waiting.reject(new Error(error));
  }

  // Sends a request; returns its number.
  send(request) {
    this.number += 1;
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ id: this.number, ...request }));
    return this.number;
  }

  ask(request) {
    return new Promise((resolve, reject) => {
      if (this.socket.readyState === WebSocket.OPEN) this.waiting.set(this.send(request), { resolve, reject });
      else reject(new Error(NO_CONNECTION));
    });
  }

  close() {
    this.done = true;
    this.socket.close();
  }
}

// The rows of the server as a Blob of CSV, over a separate connection, so that the page continues.
export function fetchCsv() {
  return new Promise((resolve, reject) => {
    const link = new Link(() => {}, () => {
      link.ask({ do: "csv" }).then(() => resolve(new Blob(link.parts, { type: "text/csv" })), reject).finally(() => link.close());
    }, () => { link.done = true; reject(new Error(NO_CONNECTION)); });
  });
}

export function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
