// What the page of a comparison says of one pose.
"use strict";
const describe = (pose) => ({
  view: pose.title,
  title: pose.title,
  role: pose.role,
  details: pose.figures.flatMap(([metric, values]) => pairs(metric, values)),
});
