for (const choice of document.querySelectorAll("select.reasons")) {
  choice.closest("label").hidden = false;
  choice.addEventListener("change", () => {
    const has = (card) => card.dataset.codes.split(" ").includes(choice.value);
    document.getElementById("marks").open ||= choice.value !== "";
    for (const frame of document.querySelectorAll("#marks details.frame")) {
      const cards = [...frame.querySelectorAll(".card")];
      cards.forEach((card) => { card.hidden = choice.value !== "" && !has(card); });
      frame.hidden = choice.value !== "" && !cards.some(has);
      frame.open = frame.open || (choice.value !== "" && !frame.hidden);
    }
  });
}
