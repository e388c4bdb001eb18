// Browsers start no worker from file://, so a site that is opened from a folder searches in a hidden frame instead.
if (location.protocol === "file:")
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      this.inside = frame.contentWindow;
      this.inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      const script = frame.contentDocument.createElement("script");
      this.ready = new Promise((resolve) => (script.onload = resolve));
      script.src = url;
      frame.contentDocument.body.append(script);
    }
    postMessage(data) {
      // One after the other: a query that came before the index was built would be lost.
      this.ready = this.ready.then(() => {
        this.inside.dispatchEvent(new MessageEvent("message", { data }));
        return new Promise((resolve) => setTimeout(resolve));
      });
    }
  };
