/* The door of a compiled module: tuples of arrays become structs, and all that could be read or
 * written beyond an array's end is checked. */
#ifndef SLAM_OBSERVER_DOOR_H
#define SLAM_OBSERVER_DOOR_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stdint.h>
#include <string.h>

typedef int64_t i64;

enum { MAX_ARRAYS = 48, SIZES = 128, UNBOUND = -1 };

/* Views of all arrays of a call, and the sizes that letters stand for in their shapes: what the
 * first array with a letter has there, or what it was set to. */
typedef struct {
    Py_buffer views[MAX_ARRAYS];
    int count;
    Py_ssize_t sizes[SIZES];
} Door;

typedef char members_have_8_bytes[sizeof(void *) == 8 && sizeof(double) == 8 ? 1 : -1];

static inline void open_door(Door *door) {
    door->count = 0;
    for (int letter = 0; letter < SIZES; letter++)
        door->sizes[letter] = letter >= '0' && letter <= '9' ? letter - '0' : UNBOUND;
}

static inline void close_door(Door *door) {
    while (door->count)
        PyBuffer_Release(&door->views[--door->count]);
}

static inline int refuse(const char *what) {
    PyErr_Format(PyExc_ValueError, "%s: a part has not the type or shape that belongs here", what);
    return 0;
}

/* The address of an array as ``spec`` describes it, a kind and its shape; NULL with an error. */
static inline void *read_array(Door *door, PyObject *array, const char *spec, const char *what) {
    static double nothing; /* of an array without entries there may be no address */
    char kind = spec[0] == 'D' ? 'd' : spec[0] == 'L' ? 'l' : spec[0];
    int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (kind == spec[0] ? 0 : PyBUF_WRITABLE);
    Py_buffer *view = &door->views[door->count];
    if (door->count == MAX_ARRAYS || PyObject_GetBuffer(array, view, flags)) {
        if (!PyErr_Occurred())
            refuse(what);
        return NULL;
    }
    door->count++;
    const char *format = view->format == NULL ? "B" : view->format;
    int is_fit = (format[0] == kind || (kind == 'l' && format[0] == 'q')) && format[1] == '\0'
                 && view->itemsize == (kind == '?' ? 1 : 8) && view->ndim == (int)strlen(spec + 1);
    for (int d = 0; is_fit && d < view->ndim; d++) {
        Py_ssize_t *size = &door->sizes[(int)spec[1 + d]];
        *size = *size == UNBOUND ? view->shape[d] : *size;
        is_fit = view->shape[d] == *size;
    }
    if (!is_fit)
        refuse(what);
    return !is_fit ? NULL : view->buf == NULL ? &nothing : view->buf;
}

/* Read a tuple into a struct whose first members are its fields, 8 bytes each: by their specs, an
 * int64 i, a number f, a truth b, or an array of float64 d, int64 l or bool ?, in capitals where
 * it is written to; after ~ it may be None, and is NULL then. */
static inline int read_fields(Door *door, PyObject *tuple, const char *const specs[], void *fields,
                       const char *what) {
    Py_ssize_t count = 0;
    while (specs[count])
        count++;
    if (!PyTuple_Check(tuple) || PyTuple_GET_SIZE(tuple) != count)
        return refuse(what);
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *item = PyTuple_GET_ITEM(tuple, i);
        const char *spec = specs[i] + (specs[i][0] == '~');
        char *member = (char *)fields + 8 * i;
        if (spec[0] == 'f') {
            double number = PyFloat_AsDouble(item);
            memcpy(member, &number, 8);
        } else if (spec[0] == 'i' || spec[0] == 'b') {
            i64 integer = spec[0] == 'i' ? PyLong_AsLongLong(item) : PyObject_IsTrue(item);
            memcpy(member, &integer, 8);
        } else {
            int is_none = spec != specs[i] && item == Py_None;
            void *address = is_none ? NULL : read_array(door, item, spec, what);
            memcpy(member, &address, 8);
        }
        if (PyErr_Occurred())
            return 0;
    }
    return 1;
}

/* A module that says which sources it was built from, as setup.py does to the compiler. */
static inline PyObject *make_module(PyModuleDef *definition) {
    PyObject *module = PyModule_Create(definition);
    if (module != NULL && PyModule_AddIntConstant(module, "SOURCES", SOURCES))
        Py_CLEAR(module);
    return module;
}

static inline int are_within(const i64 *numbers, Py_ssize_t count, i64 most) {
    for (Py_ssize_t j = 0; j < count; j++)
        if (numbers[j] < 0 || numbers[j] > most)
            return 0;
    return 1;
}

#endif
