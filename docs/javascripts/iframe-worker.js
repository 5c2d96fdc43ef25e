// The search of the site runs in a Worker, which browsers refuse on file: pages. There this class runs the same script in
// a hidden frame. The theme recognises it by its name.
"use strict";

class IFrameWorker extends EventTarget {
  constructor(url) {
    super();
    this.onmessage = null;
    this.waiting = [];
    this.frame = document.createElement("iframe");
    this.frame.hidden = true;
    document.body.append(this.frame);
    const inside = this.frame.contentWindow;
    inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
    inside.importScripts = (...urls) => urls.reduce((done, one) => done.then(() => this.load(one)), Promise.resolve());
    this.addEventListener("message", (event) => this.onmessage?.(event));
    this.load(url).then(() => {
      this.waiting.forEach((data) => this.deliver(data));
      this.waiting = null;
    });
  }

  load(url) {
    const script = this.frame.contentDocument.createElement("script");
    script.src = new URL(url, location.href).href;
    return new Promise((resolve, reject) => {
      script.onload = resolve;
      script.onerror = reject;
      this.frame.contentDocument.head.append(script);
    });
  }

  deliver(data) {
    this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data }));
  }

  postMessage(data) {
    if (this.waiting) this.waiting.push(data);
    else this.deliver(data);
  }

  terminate() {
    this.frame.remove();
  }
}

if (location.protocol === "file:") window.Worker = window.IFrameWorker = IFrameWorker;
