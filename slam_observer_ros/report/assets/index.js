// @ts-check
'use strict';
/* Sorts a table by the column whose heading is clicked; a second click turns the order round. */

/** What a cell is sorted by: its number if it has one, else its text. @param {HTMLTableRowElement} row @param {number} column @returns {number|string} */
function valueOf(row, column) {
  const cell = row.cells[column];
  return cell.classList.contains('number') ? Number(cell.dataset.value ?? 'NaN') : cell.textContent ?? '';
}

/** What is not known comes last in either order. @param {number|string} a @param {number|string} b @param {number} sign */
function order(a, b, sign) {
  if (typeof a === 'string' || typeof b === 'string') return sign * String(a).localeCompare(String(b));
  if (Number.isNaN(a) || Number.isNaN(b)) return Number(Number.isNaN(a)) - Number(Number.isNaN(b));
  return sign * (a - b);
}

/** @param {HTMLTableElement} table @param {number} column @param {HTMLTableCellElement} heading */
function sortBy(table, column, heading) {
  const sign = heading.ariaSort === 'ascending' ? -1 : 1;
  for (const other of table.tHead?.rows[0].cells ?? []) other.removeAttribute('aria-sort');
  heading.ariaSort = sign === 1 ? 'ascending' : 'descending';
  const rows = [...table.tBodies[0].rows];
  rows.sort((a, b) => order(valueOf(a, column), valueOf(b, column), sign));
  table.tBodies[0].append(...rows);
}

for (const table of document.querySelectorAll('table')) {
  for (const [column, heading] of [...(table.tHead?.rows[0].cells ?? [])].entries()) {
    heading.querySelector('button')?.addEventListener('click', () => sortBy(table, column, heading));
  }
}
