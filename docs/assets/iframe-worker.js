// The search runs in a worker, which browsers refuse to a page opened from disk: there its script runs in a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(address) {
      super();
      this.waiting = []; // messages to a script that is not loaded yet
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      this.frame.addEventListener("load", () => this.load(new URL(address, location.href)), {once: true});
      document.documentElement.append(this.frame);
    }

    load(address) {
      const script = this.frame.contentDocument.createElement("script");
      this.frame.contentWindow.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", {data}));
      script.src = address;
      script.onload = () => {
        const waiting = this.waiting;
        this.waiting = null;
        waiting.forEach((data) => this.postMessage(data));
      };
      this.frame.contentDocument.head.append(script);
    }

    postMessage(data) {
      if (this.waiting) this.waiting.push(data);
      else this.frame.contentWindow.dispatchEvent(new MessageEvent("message", {data}));
    }
  };
}
