// Reports when the page does not work: old browser, scripts that did not load, unhandled errors. A plain script in the
// syntax of 2009, so that it runs where modules do not.
(function () {
  "use strict";

  var OLDEST = "Chrome, Edge or Android’s browser 109, Firefox 115, or Safari 16 (iOS 16)"; // scripts/browsers.json
  var SCRIPTS_LATE_MS = 30000;
  var SHOWN_MAX = 5; // errors in the report
  var COUNT_MAX = 100;
  var box = null;
  var lines = null;
  var errors = [];
  var count = 0;
  var isStarted = false;

  /** Return true without features that the oldest supported browsers have. */
  function isOld() {
    return !("noModule" in document.createElement("script")) || !Array.prototype.findLast || !window.CSS || !CSS.supports
      || !CSS.supports("height", "1dvh") || !CSS.supports("container-type", "inline-size");
  }

  function add(parent, tag, text) {
    var element = document.createElement(tag);
    element.textContent = text;
    parent.appendChild(element);
    return element;
  }

  function addButton(parent, text, press) {
    var button = add(parent, "button", text);
    button.type = "button";
    button.addEventListener("click", press);
  }

  /** Show the report above the page, without covering it. */
  function show(title, text) {
    if (!document.body) {
      document.addEventListener("DOMContentLoaded", function () { show(title, text); });
      return;
    }
    if (!box) {
      box = document.createElement("section");
      box.id = "guard";
      box.setAttribute("role", "alert");
      add(box, "h2", "");
      add(box, "p", "");
      lines = add(box, "pre", "");
      var row = add(box, "p", "");
      addButton(row, "Reload", function () { location.reload(); });
      addButton(row, "Dismiss", function () { box.hidden = true; });
      document.body.insertBefore(box, document.body.firstChild);
    }
    if (box.firstChild.textContent !== title) {
      box.firstChild.textContent = title;
      box.childNodes[1].textContent = text;
      box.hidden = false; // another report than the dismissed one
    }
    if (!errors.length) return;
    var more = count > errors.length ? "\n… and " + (count - errors.length) + " more" + (count < COUNT_MAX ? "" : " at least") : "";
    // Without query and fragment: they may contain a ticket.
    lines.textContent = errors.join("\n") + more + "\n" + location.origin + location.pathname + "\n" + navigator.userAgent;
  }

  function report(error) {
    if (count >= COUNT_MAX) return; // an error may occur with each frame
    count += 1;
    if (errors.length < SHOWN_MAX && errors.indexOf(error) < 0) errors.push(error);
    if (isOld()) {
      showOld();
    } else if (isStarted) {
      show("Error on this page", "The display may be wrong or frozen: reload the page. Server and recordings are not affected. If it recurs, report these lines:");
    } else {
      show("This page could not start", "A script failed. Reload the page. If it recurs, report these lines:");
    }
  }

  function showOld() {
    show("This browser is too old for this page", "Parts of the page do not work. Required: " + OLDEST + ", or newer. Update this browser or use another one.");
  }

  window.addEventListener("error", function (event) {
    var target = event.target;
    if (target && (target.tagName === "SCRIPT" || target.rel === "stylesheet")) {
      report("A file did not load: " + (target.src || target.href || "").split(/[?#]/)[0]);
      return;
    }
    if (!event.message || /^ResizeObserver loop/.test(event.message)) return; // harmless
    if (event.filename && event.filename.indexOf(location.origin + "/") !== 0) return; // browser extension
    var place = event.filename ? " (" + event.filename.split(/[?#]/)[0].slice(location.origin.length) + ":" + event.lineno + ":" + event.colno + ")" : "";
    report(event.message + place);
  }, true);

  window.addEventListener("unhandledrejection", function (event) {
    var reason = event.reason;
    if (reason && reason.name === "AbortError") return; // aborted by this page
    var stack = String(reason && reason.stack || "");
    if (/(?:-extension|extension):\/\//.test(stack)) return;
    var at = stack.split("\n").filter(function (line) { return line.indexOf(location.origin) >= 0; })[0] || "";
    report(String(reason) + (at ? " (" + at.replace(location.origin, "").replace(/^\s+/, "") + ")" : ""));
  });

  // A module's load event follows its run.
  document.addEventListener("load", function (event) {
    if (event.target.tagName !== "SCRIPT" || event.target.type !== "module") return;
    isStarted = true;
    if (box && !count && !isOld()) box.hidden = true; // late
  }, true);

  document.addEventListener("DOMContentLoaded", function () {
    if (isOld()) {
      showOld();
      return;
    }
    setTimeout(function () {
      if (!isStarted) show("Loading", "Scripts not loaded after " + SCRIPTS_LATE_MS / 1000 + " s: slow network or busy server. The page starts once they load.");
    }, SCRIPTS_LATE_MS);
  });
})();
