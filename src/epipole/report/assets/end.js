/* Runs last: everything before it ran to its end. */
document.documentElement.dataset.ready = "yes";
